"""Tables as plain cells, and as Markdown, LaTeX and CSV."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from sparsestreet.records.file import csv_text

ABSENT = "-"


@dataclass(frozen=True)
class Cell:
    """One entry of a table."""

    text: str = ABSENT
    bold: bool = False
    published: bool = False
    """Whether it is the paper's, not ours."""
    runs: tuple[str, ...] = ()
    """Names of the runs that it is of."""


@dataclass(frozen=True)
class Grid:
    """A table."""

    name: str
    """An identifier, such as "differences"."""
    title: str
    header: tuple[tuple[str, str], ...]
    """Of each column: the heading above several, and its own."""
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"{self.name}: a row has {len(row)} cells, the header {len(self.header)}")

    @property
    def spans(self) -> list[tuple[str, int]]:
        """The upper headings, each with the number of its columns."""
        return [(text, len(list(group))) for text, group in groupby(group for group, _ in self.header)]


def markdown(grids: Sequence[Grid]) -> str:
    """All of them with their notes."""
    return "\n".join(_markdown(grid) for grid in grids)


def _markdown(grid: Grid) -> str:
    header = [f"{group} {heading}".strip() for group, heading in grid.header]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    lines += [[f"**{cell.text}**" if cell.bold else cell.text for cell in row] for row in grid.rows]
    table = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    notes = "".join(f"- {note}\n" for note in grid.notes)
    return f"### {grid.title}\n\n{table}\n\n{notes}"


def latex(grids: Sequence[Grid]) -> str:
    """All of them as tables for ``booktabs``; published figures in italics."""
    return "% \\usepackage{booktabs,graphicx}\n" + "\n".join(_latex(grid) for grid in grids)


def _latex(grid: Grid) -> str:
    groups = " & ".join(f"\\multicolumn{{{span}}}{{c}}{{{_escaped(text)}}}" for text, span in grid.spans)
    header = " & ".join(_escaped(heading) for _, heading in grid.header)
    rows = "\n".join(" & ".join(map(_latex_cell, row)) + " \\\\" for row in grid.rows)
    notes = " ".join(f"{_escaped(note)}." for note in grid.notes)
    return (
        f"\\begin{{table*}}\n\\centering\n\\caption{{{_escaped(grid.title)}. {notes}}}\n\\label{{tab:{grid.name}}}\n"
        f"\\resizebox{{\\textwidth}}{{!}}{{\\begin{{tabular}}{{l{'r' * (len(grid.header) - 1)}}}\n\\toprule\n"
        f"{groups} \\\\\n{header} \\\\\n\\midrule\n{rows}\n\\bottomrule\n\\end{{tabular}}}}\n\\end{{table*}}\n"
    )


def _latex_cell(cell: Cell) -> str:
    text = _escaped(cell.text)
    text = f"\\textit{{{text}}}" if cell.published and cell.text != ABSENT else text
    return f"\\textbf{{{text}}}" if cell.bold else text


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {sign: f"\\{sign}" for sign in "&%$#_{}"}


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)


def comma_separated(grids: Sequence[Grid]) -> str:
    """All of them in one file, a line a cell: table, row, column, value, whether published, whether proven, runs."""
    lines = []
    for grid in grids:
        for row in grid.rows:
            for (group, heading), cell in zip(grid.header[1:], row[1:], strict=True):
                column = f"{group} {heading}".strip()
                marks = (int(cell.published), int(cell.bold), " ".join(cell.runs))
                lines.append((grid.name, row[0].text, column, cell.text, *marks))
    return csv_text(("table", "row", "column", "value", "published", "bold", "runs"), lines)
