"""Tables of cells as Markdown, LaTeX and CSV, with the means, intervals and marks that their cells show."""

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import compress, groupby

from scipy.special import stdtrit

from sparsestreet.records.file import csv_text
from sparsestreet.records.geometry import WITHIN
from sparsestreet.records.summary import RunSummary

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
    """Return a rounded number, with a mark if one is given, and its exact value.

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


THEIRS = ", paper"
"""The end of a heading whose column has published numbers."""


def without_empty(
    header: Sequence[tuple[str, str]], rows: Sequence[tuple[Cell, ...]]
) -> tuple[list[tuple[str, str]], list[tuple[Cell, ...]]]:
    """Return header and rows without columns for published numbers of which there are none."""
    shown = [not heading.endswith(THEIRS) or any(row[at].text != ABSENT for row in rows)
             for at, (_, heading) in enumerate(header)]  # fmt: skip
    return list(compress(header, shown)), [tuple(compress(row, shown)) for row in rows]


def markdown(grids: Sequence[Grid]) -> str:
    """Return the tables with their notes as Markdown.

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
    notes = "".join(f"- {note}\n" for note in grid.notes)
    return f"### {grid.title}\n\n{markdown_lines(lines)}\n\n{notes}"


def markdown_lines(lines: Iterable[Iterable[str]]) -> str:
    """Return lines of cells as a Markdown table."""
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def latex(grids: Sequence[Grid]) -> str:
    """Return the tables as LaTeX for ``booktabs``; published numbers are in italics."""
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
    """Return the tables as one CSV, a line a cell: table, row, column, value, whether published, whether bold, runs.

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


@dataclass(frozen=True)
class Quantity:
    """A column of numbers and of their differences to a baseline."""

    heading: str
    column: str
    """Of ``run_frame``."""
    text: str
    """Format of its mean."""
    relative: bool = False
    """True: a comparison with the baseline is in per cent of it. False: it is a signed difference."""
    count: bool = False
    """Whether it counts Gaussians, which a cap can limit."""
    clock: str = ""
    """What is timed, a key of ``CLOCKS``: a time of a machine that was not quiet compares with none. Empty: no time."""


GEOMETRY = (
    Quantity("median range error, m", "median range error", "{:.3f}"),
    Quantity(f"within {WITHIN:g} m, %", "ranges within", "{:.1f}"),
)
"""Columns of the ranges along lidar rays that a camera sees too (docs/metrics.md); runs without lidar have neither."""


CONFIDENCE = 0.95


@dataclass(frozen=True)
class Spread:
    """A mean with the sample standard deviation (n - 1); the latter is None below two values."""

    mean: float
    sd: float | None
    n: int

    @property
    def interval(self) -> tuple[float, float] | None:
        """The t interval with n - 1 degrees of freedom, which holds the true mean with ``CONFIDENCE`` if values are
        normal; None for a single value, which says nothing about its spread."""
        if self.sd is None:
            return None
        reach = float(stdtrit(self.n - 1, (1 + CONFIDENCE) / 2)) * self.sd / math.sqrt(self.n)
        return self.mean - reach, self.mean + reach

    @property
    def proven(self) -> bool:
        """Whether the interval excludes 0."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)


def spread(values: Sequence[float]) -> Spread | None:
    """Return mean and sample standard deviation; None without values.

    >>> spread([24.0, 26.0, 28.0])
    Spread(mean=26.0, sd=2.0, n=3)
    """
    if not values:
        return None
    return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None, len(values))


CAPPED = "†"
"""Marks counts that a node's ``max_gaussians`` limited."""
BUSY = "§"
"""Marks times that are of a machine that was not quiet, as the ``noise`` of their record says."""
LEFT_OUT = f"{ABSENT} {BUSY}"
"""In the place of a difference or ratio of times of which one has that mark."""


def frames_steady(run: RunSummary) -> bool:
    """Return whether the machine was quiet while frames were timed."""
    return run.latency.noise.quiet


def training_steady(run: RunSummary) -> bool:
    """Return whether the machine was quiet while the run trained; a record that does not say counts as quiet."""
    return run.run.noise is None or run.run.noise.quiet


CLOCKS: dict[str, Callable[[RunSummary], bool]] = {"frames": frames_steady, "training": training_steady}
"""What is timed -> whether its times are of a quiet machine."""


def busy_note(named: Iterable[tuple[str, RunSummary]]) -> list[str]:
    """Return a note that names the rows with marked times, for (name of a row, run) pairs; nothing without any."""
    named = list(named)
    busy = {what: sorted({name for name, run in named if not steady(run)}) for what, steady in CLOCKS.items()}
    said = [f"{what} of {', '.join(names)}" for what, names in busy.items() if names]
    return busy_words("; ".join(said))


def busy_words(said: str) -> list[str]:
    """Return the note that explains the mark of times; nothing where none has it."""
    return [f"{BUSY} times of a machine that was not quiet, compared with no other: {said}"] if said else []
