"""Draws sections as tables in a terminal, as Markdown and as a figure."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sparsestreet.pictures.plots import plot_runs
from sparsestreet.records.quality import HELD_OUT
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.notes import BUSY, CAPPED
from sparsestreet.report.quantities import Quantity
from sparsestreet.report.sections import Row, Section
from sparsestreet.report.spread import Spread
from sparsestreet.report.variants import variants

ABSENT = "-"

_MOST_COLUMNS = 5
"""Largest number of variants and differences that stand in columns; more become rows if the terminal is wide enough."""


def tables(sections: Sequence[Section], width: int = 80) -> list[Table | Text]:
    """Returns title, tables and notes of the sections for ``rich.console.Console``, ``width`` characters wide.

    Variants are columns, spread over as many tables as needed to cut no text. Many variants (a sweep) are rows if the
    terminal is wide enough.
    """
    return [part for section in sections for part in _drawn(section, width)]


def markdown(sections: Sequence[Section]) -> str:
    """Returns the sections as Markdown tables with notes; sections by camera have a row for each camera and region."""
    blocks = []
    for section in sections:
        lines = _lines(section)
        header, *lines = zip(*lines, strict=True) if section.by_camera else lines
        texts = 1 if section.by_camera else 2
        rule = ["---"] * texts + ["---:"] * (len(header) - texts)
        table = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (header, rule, *lines)
        )
        notes = "\n".join(f"- {note}" for note in section.notes)
        blocks.append(f"### {section.title}\n\n{table}\n\n{notes}\n")
    return "\n".join(blocks)


def figure(records: Sequence[RunRecord], path: Path) -> None:
    """Writes a scatter of all runs: PSNR of held-out views against Gaussians, one color for each variant.

    Raises ValueError if no run has held-out views.
    """
    runs = [record.summary for record in records]
    points = {
        variant.name: [
            (run.gaussians_total, psnr) for run in variant.runs if (psnr := run.mean("psnr_full", HELD_OUT)) is not None
        ]
        for variant in variants(runs)
    }
    if not any(points.values()):
        raise ValueError("no run was evaluated on held-out views, which the figure shows: train with split.stride > 0")
    plot_runs(path, {name: some for name, some in points.items() if some})


def _drawn(section: Section, width: int) -> list[Table | Text]:
    lines = _lines(section)
    if len(section.rows) > _MOST_COLUMNS and sum(map(_room, zip(*lines, strict=True))) < width:
        blocks = [lines]
    else:
        labels, *columns = lines
        blocks = [list(zip(labels, *some, strict=True)) for some in _fitting(columns, width - 1 - _room(labels))]
    # Texts, because rich would read the square brackets of strings as markup.
    title, notes = Text(section.title, style="bold"), Text("\n".join(section.notes) + "\n")
    return [title, *map(_table, blocks), notes]


def _fitting(columns: Sequence[Sequence[str]], width: int) -> list[list[Sequence[str]]]:
    """Returns consecutive columns in groups that fit a width, at least one column in each."""
    groups: list[list[Sequence[str]]] = []
    left = 0
    for column in columns:
        if not groups or _room(column) > left:
            groups.append([])
            left = width
        groups[-1].append(column)
        left -= _room(column)
    return groups


def _room(column: Sequence[str]) -> int:
    """Returns the width of a column in characters: its heading may break between words, its cells may not."""
    heading, *cells = column
    return max(*map(len, heading.split()), *map(len, cells)) + 3


def _table(lines: Sequence[Sequence[str]]) -> Table:
    table = Table()
    for index, heading in enumerate(lines[0]):
        table.add_column(Text(heading), justify="right" if index else "left", overflow="fold")
    for line in lines[1:]:
        table.add_row(*map(Text, line))
    return table


def _lines(section: Section) -> list[list[str]]:
    """Returns header and rows as texts."""
    header = ["method", "runs", *(quantity.heading for quantity in section.quantities)]
    return [header, *(_texts(row, section.quantities) for row in section.rows)]


def _texts(row: Row, quantities: Sequence[Quantity]) -> list[str]:
    busy = row.busy or (False,) * len(quantities)
    cells = [_cell(*one, row) for one in zip(row.cells, quantities, busy, strict=True)]
    return [row.label, row.runs, *cells]


def _cell(cell: Spread | None, quantity: Quantity, busy: bool, row: Row) -> str:
    """Returns mean ± sd, marks of a count that a cap limited and of a time of a busy machine, and n if it differs.

    A difference holds no time of a busy machine: it has the mark alone where nothing else is left.
    """
    if cell is None:
        return BUSY if busy else ABSENT
    percentage = row.difference and quantity.relative
    number = "{:.1f}".format if percentage else quantity.text
    sign = "" if not row.difference or percentage else "+" if cell.mean >= 0 else "-"
    text = sign + number(abs(cell.mean) if sign else cell.mean)
    if cell.sd is not None:
        text += f" ± {number(cell.sd)}"
    text += " %" if percentage else ""
    text += f" {CAPPED}" if row.capped and quantity.count else ""
    text += f" {BUSY}" if busy and not row.difference else ""
    return text if cell.n == row.n else f"{text} (n={cell.n})"
