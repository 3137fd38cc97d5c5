"""One table of many runs, from their records alone (no torch import)."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from sparsestreet.evaluation.records import RunSummary, read_summary

ABSENT = "-"

_MOST_COLUMNS = 5
"""Methods and differences beside each other in a terminal; beyond it they stand below each other."""


@dataclass(frozen=True)
class RunRecord:
    """A run's folder and what its summary says."""

    folder: Path
    summary: RunSummary


@dataclass(frozen=True)
class Spread:
    """Mean over runs, with the sample standard deviation (n - 1) where there are at least two."""

    mean: float
    sd: float | None
    n: int


@dataclass(frozen=True)
class Column:
    """One quantity of the table."""

    heading: str
    value: Callable[[RunSummary], float | None]
    text: Callable[[float], str]
    relative: bool
    """How differences to the baseline read: in per cent of it (what remains), or as a signed difference."""


@dataclass(frozen=True)
class Row:
    """One method, or the difference of a method to the baseline."""

    label: str
    seeds: tuple[int, ...]
    cells: tuple[Spread | None, ...]
    difference: bool


@dataclass(frozen=True)
class Section:
    """Runs that may stand in one table: same scene, split and resolution."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]


def collect(roots: Iterable[Path]) -> list[RunRecord]:
    """Every run below the given folders, sorted by path, each once.

    Raises FileNotFoundError for a root without records, RecordError (naming the file) for a malformed one.
    """
    folders: set[Path] = set()
    for root in roots:
        found = {path.parents[1] for path in root.rglob("records/summary.json")}
        if not found:
            raise FileNotFoundError(f"{root} holds no records/summary.json: train and evaluate a run there first")
        folders |= {folder.resolve() for folder in found}
    return [RunRecord(folder, read_summary(folder / "records" / "summary.json")) for folder in sorted(folders)]


def sections(records: Sequence[RunRecord], baseline: str | None = None) -> list[Section]:
    """Group runs by scene, split and resolution; within each, one row per method and one per difference.

    Args:
        records: the runs.
        baseline: the method that others are compared with, pairwise by seed; None for no differences. A section
            without it has no differences either and says so in its notes.

    Raises ValueError if no record has the baseline, or two records define one metric differently.
    """
    summaries = [record.summary for record in records]
    methods = sorted({summary.run.method for summary in summaries})
    if baseline is not None and baseline not in methods:
        raise ValueError(f"no run has the baseline method {baseline!r}: choose one of {methods}")
    _check_definitions(records)
    groups: dict[tuple[str, str, str], list[RunSummary]] = {}
    for summary in summaries:
        key = (summary.run.scene, summary.run.split, " ".join(summary.resolutions))
        groups.setdefault(key, []).append(summary)
    return [_section(key, group, baseline) for key, group in sorted(groups.items())]


def tables(records: Sequence[RunRecord], baseline: str | None = None) -> list[Table]:
    """The sections as rich tables for a terminal; print them with ``rich.console.Console``.

    A few methods stand as columns, which fits 80 characters; many (a sweep) stand as rows.
    """
    return [_drawn(section) for section in sections(records, baseline)]


def _drawn(section: Section) -> Table:
    lines = [
        ["method", "runs", *(column.heading for column in section.columns)],
        *(_texts(row, section.columns) for row in section.rows),
    ]
    if len(section.rows) <= _MOST_COLUMNS:
        lines = [list(line) for line in zip(*lines, strict=True)]
    table = Table(title=section.title, caption="\n".join(section.notes), caption_justify="left")
    for index, heading in enumerate(lines[0]):
        table.add_column(heading, justify="right" if index else "left")
    for line in lines[1:]:
        table.add_row(*line)
    return table


def markdown(records: Sequence[RunRecord], baseline: str | None = None) -> str:
    """The sections as Markdown tables with their notes."""
    blocks = []
    for section in sections(records, baseline):
        header = ["method", "runs", *(column.heading for column in section.columns)]
        rule = ["---", "---", *("---:" for _ in section.columns)]
        lines = [header, rule, *(_texts(row, section.columns) for row in section.rows)]
        table = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        notes = "\n".join(f"- {note}" for note in section.notes)
        blocks.append(f"### {section.title}\n\n{table}\n\n{notes}\n")
    return "\n".join(blocks)


def spread(values: Sequence[float]) -> Spread | None:
    """Mean and sample standard deviation; None of no values."""
    if not values:
        return None
    return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None, len(values))


def _section(key: tuple[str, str, str], group: list[RunSummary], baseline: str | None) -> Section:
    columns = _columns(group)
    by_method: dict[str, list[RunSummary]] = {}
    for summary in sorted(group, key=lambda summary: (summary.run.method != baseline, summary.run.method)):
        by_method.setdefault(summary.run.method, []).append(summary)
    rows = [_method_row(method, runs, columns) for method, runs in by_method.items()]
    notes = _notes(group)
    if baseline is not None and baseline in by_method:
        others = [method for method in by_method if method != baseline]
        rows += [_difference_row(method, by_method[method], by_method[baseline], columns) for method in others]
        notes.append(f"differences are to {baseline}, paired by seed; per cent is what remains of it")
    elif baseline is not None:
        notes.append(f"no run of the baseline {baseline} here, so no differences")
    scene, split, resolution = key
    return Section(f"{scene} ({resolution}; held out: {split})", columns, tuple(rows), tuple(notes))


def _columns(group: Sequence[RunSummary]) -> tuple[Column, ...]:
    classes = list(dict.fromkeys(name for summary in group for name in summary.gaussians))
    return (
        Column("PSNR", _metric("psnr_full"), "{:.2f}".format, False),
        Column("SSIM", _metric("ssim_uniform7_full"), "{:.4f}".format, False),
        Column("vehicle PSNR", _metric("psnr_vehicle"), "{:.2f}".format, False),
        Column("vehicle SSIM", _metric("ssim_uniform7_vehicle"), "{:.4f}".format, False),
        Column("human PSNR", _metric("psnr_human"), "{:.2f}".format, False),
        Column("Gaussians", lambda summary: float(summary.gaussians_total), "{:,.0f}".format, True),
        *(Column(name, _class_count(name), "{:,.0f}".format, True) for name in classes),
        Column("MB", lambda summary: summary.bytes_total / 1e6, "{:.2f}".format, True),
        Column("ms/frame", lambda summary: summary.latency.p50, "{:.1f}".format, True),
        Column("train s", lambda summary: summary.run.training_seconds, "{:.0f}".format, True),
    )


def _metric(name: str) -> Callable[[RunSummary], float | None]:
    return lambda summary: summary.quality[name].mean if name in summary.quality else None


def _class_count(name: str) -> Callable[[RunSummary], float | None]:
    return lambda summary: float(summary.gaussians[name]) if name in summary.gaussians else None


def _method_row(method: str, runs: Sequence[RunSummary], columns: tuple[Column, ...]) -> Row:
    cells = [spread([value for summary in runs if (value := column.value(summary)) is not None]) for column in columns]
    return Row(method, tuple(sorted(summary.run.seed for summary in runs)), tuple(cells), False)


def _difference_row(
    method: str, runs: Sequence[RunSummary], baseline: Sequence[RunSummary], columns: tuple[Column, ...]
) -> Row:
    """Differences of runs with the same seed; several runs of one seed count as their mean."""
    seeds = sorted({summary.run.seed for summary in runs} & {summary.run.seed for summary in baseline})
    cells = []
    for column in columns:
        pairs = [(_of_seed(runs, seed, column), _of_seed(baseline, seed, column)) for seed in seeds]
        cells.append(spread([_difference(*pair, column) for pair in pairs if _comparable(*pair, column)]))
    return Row(f"{method} against {baseline[0].run.method}", tuple(seeds), tuple(cells), True)


def _of_seed(runs: Sequence[RunSummary], seed: int, column: Column) -> float | None:
    found = spread([v for run in runs if run.run.seed == seed and (v := column.value(run)) is not None])
    return None if found is None else found.mean


def _comparable(value: float | None, reference: float | None, column: Column) -> bool:
    return value is not None and reference is not None and not (column.relative and reference == 0)


def _difference(value: float, reference: float, column: Column) -> float:
    return 100 * value / reference if column.relative else value - reference


def _texts(row: Row, columns: tuple[Column, ...]) -> list[str]:
    seeds = ",".join(str(seed) for seed in row.seeds)
    runs = f"n={len(row.seeds)} (seed {seeds})" if row.seeds else "no shared seed"
    return [row.label, runs, *(_cell(cell, column, row) for cell, column in zip(row.cells, columns, strict=True))]


def _cell(cell: Spread | None, column: Column, row: Row) -> str:
    """mean ± sd; n is added where it is not the row's."""
    if cell is None:
        return ABSENT
    percentage = row.difference and column.relative
    number = "{:.1f}".format if percentage else column.text
    sign = "" if not row.difference or percentage else "+" if cell.mean >= 0 else "-"
    text = sign + number(abs(cell.mean) if sign else cell.mean)
    if cell.sd is not None:
        text += f" ± {number(cell.sd)}"
    text += " %" if percentage else ""
    return text if cell.n == len(row.seeds) else f"{text} (n={cell.n})"


def _notes(group: Sequence[RunSummary]) -> list[str]:
    """What the numbers are, and where they are not alike."""
    notes = [
        "mean ± sample sd over runs; n=1 has no spread and proves nothing below the noise of runs",
        "PSNR: psnr_full, in dB; SSIM: ssim_uniform7_full; masked: psnr_vehicle, ssim_uniform7_vehicle, psnr_human "
        "(images without the mask skipped); definitions in each summary.json",
        f"MB: 10^6 bytes of parameters; ms/frame: median, {group[0].latency.protocol}",
    ]
    clocks = sorted({f"{run.latency.device}, {run.latency.threads} threads" for run in group})
    notes.append(
        ("ms/frame are not comparable, measured on: " if len(clocks) > 1 else "measured on ") + "; ".join(clocks)
    )
    if len({run.latency.protocol for run in group}) > 1:
        notes.append("ms/frame were taken with different numbers of renders; see each summary.json")
    if any(run.source.dirty for run in group):
        notes.append("some runs were made from code with uncommitted changes")
    notes.append(_guards_note(group))
    return notes


def _guards_note(group: Sequence[RunSummary]) -> str:
    """The alarms of every run that has any."""
    fired = [
        f"{run.run.method} (seed {run.run.seed}) " + ", ".join(f"{name} {count:,}" for name, count in alarms.items())
        for run in group
        if run.guards is not None and (alarms := run.guards.alarms)
    ]
    uncounted = sum(run.guards is None for run in group)
    if uncounted == len(group):
        return "guards: not counted"
    note = "guards: " + ("; ".join(fired) or "none fired")
    return note if not uncounted else f"{note} ({uncounted} of {len(group)} runs did not count them)"


def _check_definitions(records: Sequence[RunRecord]) -> None:
    seen: dict[str, tuple[str, Path]] = {}
    for record in records:
        for name, definition in record.summary.definitions.items():
            known, folder = seen.setdefault(name, (definition, record.folder))
            if known != definition:
                raise ValueError(f"{name} means different things in {folder} and {record.folder}: evaluate one again")
