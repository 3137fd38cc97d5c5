"""Sections as tables in a terminal, as Markdown and as a figure."""

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sparsestreet.evaluation.plots import plot_runs
from sparsestreet.evaluation.records import HELD_OUT
from sparsestreet.evaluation.report.collect import RunRecord
from sparsestreet.evaluation.report.notes import CAPPED
from sparsestreet.evaluation.report.quantities import Quantity
from sparsestreet.evaluation.report.sections import Row, Section
from sparsestreet.evaluation.report.spread import Spread
from sparsestreet.evaluation.report.variants import variants

ABSENT = "-"

_MOST_COLUMNS = 5
"""Variants and differences beside each other in a terminal; beyond it they stand below each other."""


def tables(sections: Sequence[Section]) -> list[Table]:
    """The sections as rich tables for a terminal; print them with ``rich.console.Console``.

    A few variants stand as columns, which fits 80 characters; many (a sweep) stand as rows.
    """
    return [_drawn(section) for section in sections]


def markdown(sections: Sequence[Section]) -> str:
    """The sections as Markdown tables with their notes."""
    blocks = []
    for section in sections:
        header, *lines = _lines(section)
        rule = ["---", "---", *("---:" for _ in section.quantities)]
        table = "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (header, rule, *lines)
        )
        notes = "\n".join(f"- {note}" for note in section.notes)
        blocks.append(f"### {section.title}\n\n{table}\n\n{notes}\n")
    return "\n".join(blocks)


def figure(records: Sequence[RunRecord], path: Path) -> None:
    """Write a scatter of all runs: PSNR of held-out views against Gaussians, one color for each variant.

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


def _drawn(section: Section) -> Table:
    lines = _lines(section)
    if len(section.rows) <= _MOST_COLUMNS:
        lines = [list(line) for line in zip(*lines, strict=True)]
    # Texts, not strings, whose square brackets rich would read as markup.
    table = Table(title=Text(section.title), caption=Text("\n".join(section.notes)), caption_justify="left")
    for index, heading in enumerate(lines[0]):
        table.add_column(Text(heading), justify="right" if index else "left")
    for line in lines[1:]:
        table.add_row(*map(Text, line))
    return table


def _lines(section: Section) -> list[list[str]]:
    """Header and rows as texts."""
    header = ["method", "runs", *(quantity.heading for quantity in section.quantities)]
    return [header, *(_texts(row, section.quantities) for row in section.rows)]


def _texts(row: Row, quantities: Sequence[Quantity]) -> list[str]:
    return [row.label, row.runs, *(_cell(cell, one, row) for cell, one in zip(row.cells, quantities, strict=True))]


def _cell(cell: Spread | None, quantity: Quantity, row: Row) -> str:
    """mean ± sd; a mark where a cap held the count down; n where it is not the row's."""
    if cell is None:
        return ABSENT
    percentage = row.difference and quantity.relative
    number = "{:.1f}".format if percentage else quantity.text
    sign = "" if not row.difference or percentage else "+" if cell.mean >= 0 else "-"
    text = sign + number(abs(cell.mean) if sign else cell.mean)
    if cell.sd is not None:
        text += f" ± {number(cell.sd)}"
    text += " %" if percentage else ""
    text += f" {CAPPED}" if row.capped and quantity.count else ""
    return text if cell.n == row.n else f"{text} (n={cell.n})"
