"""Tables of plain cells, written as Markdown, LaTeX and CSV."""

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
    """Whether the paper published the number; otherwise it is ours."""
    runs: tuple[str, ...] = ()
    """Names of the runs that the number comes from."""
    exact: str = ""
    """The number before it was rounded, for whoever points at it on the page."""


def number_cell(value: float | None, form: str, runs: tuple[str, ...], mark: str = "") -> Cell:
    """Returns a rounded number, with a mark if one is given, and its exact value.

    >>> number_cell(0.123456, "{:.2f}", ("run0",))
    Cell(text='0.12', bold=False, published=False, runs=('run0',), exact='0.123456')
    """
    return (
        Cell(runs=runs)
        if value is None
        else Cell(f"{form.format(value)} {mark}".rstrip(), runs=runs, exact=f"{value:.8g}")
    )


@dataclass(frozen=True)
class Grid:
    """A table. Raises ValueError if a row has another number of cells than the header."""

    name: str
    """An identifier, such as "differences"."""
    title: str
    header: tuple[tuple[str, str], ...]
    """For each column: the heading that it shares with its neighbors, and its own."""
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"{self.name}: a row has {len(row)} cells, the header {len(self.header)}")

    @property
    def spans(self) -> list[tuple[str, int]]:
        """The shared headings, each with the number of its columns."""
        return [(text, len(list(group))) for text, group in groupby(group for group, _ in self.header)]


def markdown(grids: Sequence[Grid]) -> str:
    """Returns the tables with their notes as Markdown.

    >>> grid = Grid("size", "Size", (("", "arm"), ("", "MB")), ((Cell("plain"), Cell("3.2", bold=True)),), ())
    >>> print(markdown([grid]).strip())
    ### Size
    <BLANKLINE>
    | arm | MB |
    | --- | ---: |
    | plain | **3.2** |
    """
    return "\n".join(_markdown(grid) for grid in grids)


def _markdown(grid: Grid) -> str:
    header = [f"{group} {heading}".strip() for group, heading in grid.header]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    lines += [[f"**{cell.text}**" if cell.bold else cell.text for cell in row] for row in grid.rows]
    table = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    notes = "".join(f"- {note}\n" for note in grid.notes)
    return f"### {grid.title}\n\n{table}\n\n{notes}"


def latex(grids: Sequence[Grid]) -> str:
    """Returns the tables as LaTeX for ``booktabs``; published numbers are in italics."""
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
    """Returns the tables as one CSV, a line a cell: table, row, column, value, whether published, whether bold, runs.

    >>> grid = Grid("size", "Size", (("", "arm"), ("", "MB")), ((Cell("plain"), Cell("3.2", runs=("run0",))),), ())
    >>> comma_separated([grid]).splitlines()[1]
    'size,plain,MB,3.2,0,0,run0'
    """
    lines = []
    for grid in grids:
        for row in grid.rows:
            for (group, heading), cell in zip(grid.header[1:], row[1:], strict=True):
                column = f"{group} {heading}".strip()
                marks = (int(cell.published), int(cell.bold), " ".join(cell.runs))
                lines.append((grid.name, row[0].text, column, cell.text, *marks))
    return csv_text(("table", "row", "column", "value", "published", "bold", "runs"), lines)
