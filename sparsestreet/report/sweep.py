"""Writes the report of a sweep from its records alone: tables, figures and one page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.metrics.definitions import DRIVESTUDIO, Protocol
from sparsestreet.records.run import FAILURE, FailedRun, read_failures
from sparsestreet.records.strict_json import write_atomically
from sparsestreet.report.collect import RunRecord, check_definitions, collect
from sparsestreet.report.costs import (
    beside_the_path,
    effects_alike,
    rendered_otherwise,
    time_to_quality,
    what_effects_cost,
    what_variants_cost,
)
from sparsestreet.report.figures import PARETO_COSTS, counts_over_time, frame_waterfall, held_out_over_time, pareto
from sparsestreet.report.page import Page, comparison_data, html
from sparsestreet.report.paper import paper_table
from sparsestreet.report.tables import Grid, comma_separated, latex, markdown
from sparsestreet.report.tradeoffs import differences, matched_budget, matched_quality, summary_line
from sparsestreet.report.variants import Variant, busy_variants, incomplete, plain_of, variants, why_apart


@dataclass(frozen=True)
class SweepReport:
    """The folder and content of a written report."""

    folder: Path
    grids: tuple[Grid, ...]
    notes: tuple[str, ...]
    summary_line: tuple[str, ...]


def write_report(sweep: Path, name: str | None = None, protocol: Protocol = DRIVESTUDIO) -> SweepReport:
    """Write ``sweep/report/``: tables.md, tables.tex, tables.csv, figures/ and index.html.

    Args:
        sweep: the folder of a sweep; runs that failed have a ``failed.json`` in it.
        name: name of the sweep in conf/sweep, for the layout and the published numbers; None: any other sweep.
        protocol: chooses the metrics.

    Raises FileNotFoundError if no run has a record, RecordError for a malformed one, ValueError if two records define
    one metric differently.
    """
    failures = read_failures(sweep)
    records = sweep_records(sweep)
    found = variants(records)
    grids = _grids(found, failures, protocol, name)
    said = summary_line(found, protocol)
    folder = sweep / "report"
    figures, absent = _figures(found, protocol, folder / "figures")
    notes = [*_notes(found, records), *absent]
    write_atomically(folder / "tables.md", _with_notes(grids, notes))
    write_atomically(folder / "tables.tex", latex(grids))
    write_atomically(folder / "tables.csv", comma_separated(grids))
    page = Page(
        title=f"Sweep {name or sweep.resolve().name}: what getting smaller costs",
        notes=notes,
        grids=grids,
        figures=figures,
        pictures=comparison_data(found),
        records=records,
        failures=failures,
        summary_line=said,
    )
    write_atomically(folder / "index.html", html(page))
    return SweepReport(folder, tuple(grids), tuple(notes), said)


def sweep_markdown(records: Sequence[RunRecord], name: str | None = None, protocol: Protocol = DRIVESTUDIO) -> str:
    """Return the tables of a sweep's runs with their notes; the rest as in ``write_report``, without failed runs."""
    check_definitions(records)
    found = variants(records)
    return _with_notes(_grids(found, (), protocol, name), _notes(found, records))


def _with_notes(grids: Sequence[Grid], notes: Sequence[str]) -> str:
    return markdown(grids) + "\n" + "".join(f"- {note}\n" for note in notes)


def _notes(found: Sequence[Variant], records: Sequence[RunRecord]) -> list[str]:
    alike = effects_alike(found)
    return [
        *incomplete(found),
        *why_apart(found),
        *_caps(found),
        *busy_variants(found),
        *([f"{alike}: records/cost.json of a run has what each costs and brings"] if alike else []),
        *_baseline(found),
        *_unfinished(records),
    ]


def sweep_records(sweep: Path) -> list[RunRecord]:
    """Return the records of a sweep's runs that did not fail. Raises the same errors as ``write_report``."""
    # The folder of a failed run may hold the record of an earlier configuration.
    records = [record for record in collect([sweep]) if not FAILURE.exists(record.folder)]
    if not records:
        raise FileNotFoundError(f"{sweep} holds no run that did not fail: run the sweep again")
    check_definitions(records)
    return records


def _grids(
    found: Sequence[Variant], failures: Sequence[tuple[Path, FailedRun]], protocol: Protocol, name: str | None
) -> list[Grid]:
    grids = [
        paper_table(found, failures, protocol, name),
        what_variants_cost(found),
        what_effects_cost(found) if effects_alike(found) is None else None,
        differences(found, protocol),
        matched_quality(found, protocol),
        matched_budget(found, protocol),
        time_to_quality(found),
        beside_the_path(found),
        rendered_otherwise(found, protocol),
    ]
    return [grid for grid in grids if grid is not None and grid.rows]


_QUALITY_CAPTION = (
    "every run small, every arm's mean large, arrows from plain to pruned over the scenes and seeds that both have, "
    "the front of the means dashed, controls grey. Hollow: the mean of an arm that lacks runs, which is in no front."
)
_OTHER_FIGURES = {
    "held_out": (
        held_out_over_time,
        "PSNR of a fixed probe of held-out views over the seconds of training, evaluation left out; a line a run.",
        "no curves of held-out PSNR over seconds: no run has curves/held_out.csv",
    ),
    "counts": (
        counts_over_time,
        "Gaussians over the steps, a line a run; dots where masks or passes of pruning took some.",
        "no counts over time: no run has records/counts.csv",
    ),
    "waterfall": (
        frame_waterfall,
        "What a frame takes longer with each node class and effect, mean over an arm's runs; nodes that hide each "
        "other cost less together than the sum.",
        "no milliseconds by node and effect: no run has records/cost.json",
    ),
}
"""Name of a file -> what draws it, its caption, and the note where no run has what it shows."""


def _figures(found: Sequence[Variant], protocol: Protocol, folder: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Return caption and SVG of each figure, and notes on figures that the records cannot give."""
    known = {}
    for cost in PARETO_COSTS:
        busy = busy_variants(found) if cost[0] in ("frame", "training") else ()
        known[f"pareto_{cost[0]}"] = (
            lambda variants, path, cost=cost: pareto(variants, protocol, cost, path),
            f"Held-out PSNR against {cost[1]}: {_QUALITY_CAPTION}" + "".join(f" {note}." for note in busy),
            f"no figure of quality against {cost[1]}: no run has both",
        )
    drawn, absent = [], []
    for name, (draw, caption, lacking) in (known | _OTHER_FIGURES).items():
        path = folder / f"{name}.svg"
        if draw(found, path):
            drawn.append((caption, path.read_text(encoding="utf-8")))
        else:
            path.unlink(missing_ok=True)  # that of an earlier report
            absent.append(lacking)
    return drawn, absent


def _baseline(found: Sequence[Variant]) -> list[str]:
    """Say why there are no differences: no variant is the plain one of another."""
    if len(found) < 2 or any(plain_of(variant, found) not in (None, variant) for variant in found):
        return []
    return [
        "no arm is a baseline, so no table of differences and no arrows: add sparsify=none to the sweep, or compare "
        "arms with sparsestreet report DIR baseline=NAME"
    ]


def _caps(found: Sequence[Variant]) -> list[str]:
    held = sorted({variant.title for variant in found for record in variant.records if record.summary.run.caps})
    return [f"counts held down by max_gaussians, so that shares of them say little: {', '.join(held)}"] if held else []


def _unfinished(records: Sequence[RunRecord]) -> list[str]:
    return [
        f"{record.folder.name} stopped at step {record.summary.run.steps:,} of {record.summary.run.max_steps:,}"
        for record in records
        if record.summary.run.steps < record.summary.run.max_steps
    ]
