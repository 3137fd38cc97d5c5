"""Sections of a report, a table each: rows of repeats, differences to a baseline, means over scenes, and notes."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import pandas as pd
from rich.table import Table
from rich.text import Text

from sparsestreet.metrics.definitions import DRIVESTUDIO, LIDAR_REACH, Protocol
from sparsestreet.records.configuration import Setting, config_hash, differing_options, without
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.summary import HELD_OUT, TRAINING, RunSummary
from sparsestreet.report.collect import UNIT, RunRecord, by_scene, by_unit, check_definitions, of_runs, summary_frame
from sparsestreet.report.tables import (
    ABSENT,
    BUSY,
    CAPPED,
    GEOMETRY,
    LEFT_OUT,
    Quantity,
    Spread,
    busy_note,
    markdown_lines,
    spread,
)
from sparsestreet.report.variants import CLIP_KEYS, Repeats, log_config, masks_note, repeats


def notes(variants: Sequence[Repeats], over_scenes: bool, protocol: Protocol) -> list[str]:
    """Return the notes of one table: first the general ones, then those about its runs."""
    runs = [run for variant in variants for run in variant.runs]
    return [
        *_general(runs, over_scenes, protocol),
        *masks_note(runs),
        *_absent(runs, protocol),
        *_timing(runs),
        *_training(runs),
        *busy_note((variant.name, run) for variant in variants for run in variant.runs),
        *(_scenes(variants) if over_scenes else ()),
        *_lacking_seeds(variants),
        *_long_names(variants),
        *_repeated_seeds(variants),
        *_unfinished(variants),
        *_caps(variants),
        _guards(variants),
    ]


def _general(runs: Sequence[RunSummary], over_scenes: bool, protocol: Protocol) -> list[str]:
    alone = "n=1 has no spread and proves nothing below the noise of runs"
    mean = (
        "each scene counts once, with the mean of its runs; ± is the sample sd over scenes"
        if over_scenes
        else f"mean ± sample sd over runs; {alone}"
    )
    return [
        mean,
        f"of {_views(runs)}, protocol {protocol.name}: PSNR {protocol.psnr}, in dB; SSIM {protocol.ssim}; masked: "
        f"{', '.join((*protocol.vehicle, *protocol.human))} (images without the mask skipped); definitions in each "
        "summary.json",
        *_lidar(runs),
        *_ranges(runs),
        f"MB: 10^6 bytes of parameters; ms/frame: median, {runs[0].latency.protocol}",
    ]


def _absent(runs: Sequence[RunSummary], protocol: Protocol) -> list[str]:
    """Say why a metric of the protocol is absent, once for each reason."""
    reasons = {
        (quantity, reason)
        for run in runs
        for quantity, reason in run.absent.items()
        if any(metric.startswith(quantity) for metric in protocol.metrics)
    }
    return [f"{quantity} n/a in some runs: {reason}" for quantity, reason in sorted(reasons)]


def _views(runs: Sequence[RunSummary]) -> str:
    return "training views (none is held out)" if all(run.main_split == TRAINING for run in runs) else "held-out views"


def _lidar(runs: Sequence[RunSummary]) -> list[str]:
    """Say what near and beyond are if a run has either."""
    names = ("psnr_near_lidar", "psnr_beyond_lidar")
    if all(run.mean(name) is None for run in runs for name in names):
        return []
    return [
        f"near: psnr_near_lidar, of pixels with a lidar return within {100 * LIDAR_REACH:g} % of the longer image "
        "side; beyond: psnr_beyond_lidar, of the others; sky left out"
    ]


def _ranges(runs: Sequence[RunSummary]) -> list[str]:
    """Say which rays the errors of ranges are of, if a run has any."""
    splits = sorted({run.geometry.split.replace("_", "-") for run in runs if run.geometry is not None})
    if not splits:
        return []
    return [
        f"median range error: along the rays of {' or '.join(splits)} sweeps whose returns lie in an image of their "
        "instant, of those that meet anything; the share within is of all of them"
    ]


def _timing(runs: Sequence[RunSummary]) -> list[str]:
    """Say where and with what ms/frame was measured."""
    places = [(run.latency.device, run.latency.threads, run.timing.machine) for run in runs]
    said = _places("ms/frame", "measured", places)
    if len({run.latency.protocol for run in runs}) > 1:
        said.append("ms/frame were taken with different numbers of renders; see each summary.json")
    return said + _commits("measured", [run.timing.source for run in runs])


def _training(runs: Sequence[RunSummary]) -> list[str]:
    """Say where train s was measured."""
    places = [(run.run.device, run.run.threads, run.run.machine) for run in runs]
    return _places("train s", "trained", places) + _commits("trained", [run.run.source for run in runs])


def _places(times: str, done: str, clocks: Sequence[tuple[str, int, Machine]]) -> list[str]:
    """Say what times depend on besides the code: each device, number of threads and machine once."""
    places = {
        f"{device}, {threads} thread{'s' if threads != 1 else ''}, {host.cores} cores, torch {host.torch}"
        for device, threads, host in clocks
    }
    apart = f"{times} are not comparable, " if len(places) > 1 else ""
    return [f"{apart}{done} on: {'; '.join(sorted(places))}" if apart else f"{done} on {'; '.join(places)}"]


def _commits(done: str, sources: Sequence[CodeVersion]) -> list[str]:
    said = []
    commits = sorted({(source.commit or "no commit")[:9] for source in sources})
    if len(commits) > 1:
        said.append(f"runs were {done} by different commits: {', '.join(commits)}")
    if any(source.dirty for source in sources):
        said.append(f"some runs were {done} by code with uncommitted changes")
    return said


def _long_names(variants: Sequence[Repeats]) -> list[str]:
    return [
        f"{variant.name}: {', '.join(variant.options)}"
        for variant in variants
        if not all(option in variant.name for option in variant.options)
    ]


def _repeated_seeds(variants: Sequence[Repeats]) -> list[str]:
    """Name seeds that occur twice: such a run counts twice, but it is no independent repeat."""
    said = []
    for variant in variants:
        times = Counter(_scenes_and_seeds(variant))
        twice = [f"seed {seed} {count} times" for (_, seed), count in sorted(times.items()) if count > 1]
        if twice:
            said.append(f"{variant.name}: {', '.join(twice)}; equal runs of one seed are no independent repeats")
    return said


def _lacking_seeds(variants: Sequence[Repeats]) -> list[str]:
    """Name variants that lack seeds which others have of a scene: seeds can differ by more than methods do."""
    every = sorted({unit for variant in variants for unit in _scenes_and_seeds(variant)})
    said = []
    for variant in variants:
        own = set(_scenes_and_seeds(variant))
        lacking: dict[str, list[str]] = {}
        for scene, seed in every:
            if (scene, seed) not in own and scene in {scene for scene, _ in own}:
                lacking.setdefault(scene, []).append(str(seed))
        words = ", ".join(f"{scene} with seed {', '.join(seeds)}" for scene, seeds in lacking.items())
        said += [f"{variant.name} has no run of {words}: compare differences, not means"] if words else []
    return said


def _scenes_and_seeds(variant: Repeats) -> list[tuple[str, int]]:
    return [(run.run.scene, run.run.seed) for run in variant.runs]


def _unfinished(variants: Sequence[Repeats]) -> list[str]:
    return [
        f"{_run(variant, run)} stopped at step {run.run.steps:,} of {run.run.max_steps:,}"
        for variant in variants
        for run in variant.runs
        if run.run.steps < run.run.max_steps
    ]


def _scenes(variants: Sequence[Repeats]) -> list[str]:
    """Name the scenes of a mean, and the variants whose mean is over fewer."""
    every = sorted({run.run.scene for variant in variants for run in variant.runs})
    said = [f"scenes: {', '.join(every)}"]
    for variant in variants:
        lacking = [scene for scene in every if scene not in {run.run.scene for run in variant.runs}]
        if lacking:
            said.append(f"{variant.name} has no run of {', '.join(lacking)}: compare differences, not means")
    return said


def _caps(variants: Sequence[Repeats]) -> list[str]:
    """Name counts that a cap limited: they say little about what a scene needs, and their shares even less."""
    found = {
        variant.name: sorted({item for run in variant.runs for item in run.run.caps.items()}) for variant in variants
    }
    return [
        f"{CAPPED} {name}: " + ", ".join(f"{node} reached its cap of {cap:,} Gaussians" for node, cap in caps)
        for name, caps in found.items()
        if caps
    ]


def _guards(variants: Sequence[Repeats]) -> str:
    """Return the alarms of every run that has any."""
    fired = [
        f"{_run(variant, run)} " + ", ".join(f"{name} {count:,}" for name, count in run.guards.alarms.items())
        for variant in variants
        for run in variant.runs
        if run.guards.alarms
    ]
    return "guards: " + ("; ".join(fired) or "none fired")


def _run(variant: Repeats, run: RunSummary) -> str:
    return f"{variant.name} (seed {run.run.seed})"


def protocol_metrics(protocol: Protocol) -> tuple[tuple[str, str, str], ...]:
    """Return heading, id and format of each metric of a protocol, and of the metrics by lidar.

    >>> [heading for heading, _, _ in protocol_metrics(DRIVESTUDIO)][:2]
    ['PSNR', 'SSIM']
    """
    return (
        ("PSNR", protocol.psnr, "{:.2f}"),
        ("SSIM", protocol.ssim, "{:.4f}"),
        *((f"LPIPS {name.split('_')[1]}", name, "{:.4f}") for name in protocol.lpips),
        ("vehicle PSNR", protocol.vehicle[0], "{:.2f}"),
        ("vehicle SSIM", protocol.vehicle[1], "{:.4f}"),
        ("human PSNR", protocol.human[0], "{:.2f}"),
        ("human SSIM", protocol.human[1], "{:.4f}"),
        ("near PSNR", "psnr_near_lidar", "{:.2f}"),
        ("beyond PSNR", "psnr_beyond_lidar", "{:.2f}"),
    )


_CAMERA_METRICS = (("", "psnr_full"), (" near", "psnr_near_lidar"), (" beyond", "psnr_beyond_lidar"))
_TIMES = (
    Quantity("MB", "MB", "{:.2f}", relative=True),
    Quantity("ms/frame", "ms/frame", "{:.1f}", relative=True, clock="frames"),
    Quantity("train s", "train s", "{:.0f}", relative=True, clock="training"),
)


def quantities(runs: Sequence[RunSummary], protocol: Protocol = DRIVESTUDIO) -> tuple[Quantity, ...]:
    """Return the quantities that at least one of the runs has, with the metrics of a protocol.

    PSNR of training views shows overfitting; all of their metrics are shown if no run holds out a view.
    """
    metrics = protocol_metrics(protocol)
    of_training = metrics if all(run.main_split == TRAINING for run in runs) else metrics[:1]
    nodes = dict.fromkeys(name for run in runs for name in run.gaussians)
    counts = {"Gaussians": "Gaussians"} | {name: f"Gaussians of {name}" for name in nodes}
    known = (
        *(Quantity(heading, f"{HELD_OUT} {name}", text) for heading, name, text in metrics),
        *GEOMETRY,
        *(Quantity(f"train-view {heading}", f"{TRAINING} {name}", text) for heading, name, text in of_training),
        *(Quantity(name, column, "{:,.0f}", relative=True, count=True) for name, column in counts.items()),
        *_TIMES,
    )
    return _measured(known, runs)


def camera_quantities(runs: Sequence[RunSummary]) -> tuple[Quantity, ...]:
    """Return PSNR of each camera, in full and by lidar, if at least one run has it; nothing for a single camera."""
    cameras = dict.fromkeys(camera for run in runs for camera in run.by_camera[run.main_split])
    known = [
        Quantity(f"camera {camera}{region}", f"camera {camera} {name}", "{:.2f}")
        for camera in cameras
        for region, name in _CAMERA_METRICS
    ]
    return _measured(known, runs) if len(cameras) > 1 else ()


def _measured(known: Iterable[Quantity], runs: Sequence[RunSummary]) -> tuple[Quantity, ...]:
    found = set(summary_frame(runs).dropna(axis="columns", how="all").columns)
    return tuple(quantity for quantity in known if quantity.column in found)


@dataclass(frozen=True)
class Row:
    """One variant, or the difference of a variant to the baseline."""

    label: str
    runs: str
    """Number of its runs (and scenes), in words."""
    n: int
    """Number of values that a cell averages: runs, pairs of runs, or scenes."""
    cells: tuple[Spread | None, ...]
    difference: bool
    capped: bool
    """Whether a node's ``max_gaussians`` limited one of its counts."""
    busy: tuple[bool, ...]
    """For each cell: whether a time of a machine that was not quiet is in it or, of a difference, left out of it."""


@dataclass(frozen=True)
class Section:
    """One table: runs on the same images of a split, or means over the scenes of a split."""

    title: str
    over_scenes: bool
    by_camera: bool
    """Whether its quantities are for single cameras."""
    quantities: tuple[Quantity, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Group:
    """The runs that become a section."""

    title: str
    log: dict[str, Setting]
    over_scenes: bool
    runs: list[RunSummary]


def sections(
    records: Sequence[RunRecord], baseline: str | None = None, protocol: Protocol = DRIVESTUDIO
) -> list[Section]:
    """Return a section for each scene, split and resolution, then sections of means over scenes.

    A scene has a row for each variant (runs of one label and configuration) with mean and spread over its runs. If a
    variant occurs in at least two scenes of a split, a section of means follows, in which each scene counts once. If
    logs have several cameras, a section of PSNR by camera follows their section.

    Args:
        records: the runs.
        baseline: label or name of the variant that others are compared with, pairwise by scene and seed; None for no
            differences. A section that lacks it has no differences and says so in its notes.
        protocol: the definitions of PSNR, SSIM and LPIPS to show.

    Raises ValueError if no record has the baseline, if several variants have it as label, or if two records define one
    metric differently.
    """
    check_definitions(records)
    runs = [record.summary for record in records]
    groups = [*_by_scene(runs), *_over_scenes(runs)]
    parted = [repeats(group.runs, runs) for group in groups]
    if baseline is not None and not any(_reference(found, baseline) for found in parted):
        names = sorted({variant.name for found in parted for variant in found})
        raise ValueError(f"no run has the baseline {baseline!r}: choose one of {names}")
    return [
        section
        for group, title, found in zip(groups, _titles(groups), parted, strict=True)
        for section in _sections(group, title, found, baseline, protocol)
    ]


def _by_scene(runs: Sequence[RunSummary]) -> list[_Group]:
    """Groups runs that were measured on the same images."""
    groups: dict[tuple[str, ...], list[RunSummary]] = {}
    for run in runs:
        key = (run.run.scene, run.run.split, " ".join(run.resolutions), config_hash(log_config(run)))
        groups.setdefault(key, []).append(run)
    return [
        _Group(f"{scene} ({resolution}; held out: {split})", log_config(group[0]), False, group)
        for (scene, split, resolution, _), group in sorted(groups.items())
    ]


def _over_scenes(runs: Sequence[RunSummary]) -> list[_Group]:
    """Groups the runs of a split over all scenes, for variants that occur in at least two scenes."""
    groups: dict[tuple[str, str], list[RunSummary]] = {}
    for run in runs:
        groups.setdefault((run.run.split, config_hash(_log_of_any_clip(run))), []).append(run)
    found = []
    for (split, _), group in sorted(groups.items()):
        several = [variant for variant in repeats(group) if len({run.run.scene for run in variant.runs}) > 1]
        if several:
            kept = [run for variant in several for run in variant.runs]
            sizes = ", ".join(sorted({size for run in kept for size in run.resolutions}))
            found.append(
                _Group(f"mean over scenes ({sizes}; held out: {split})", _log_of_any_clip(kept[0]), True, kept)
            )
    return found


def _log_of_any_clip(run: RunSummary) -> dict[str, Setting]:
    return without(log_config(run), CLIP_KEYS)


def _titles(groups: Sequence[_Group]) -> list[str]:
    """Return each group's title; groups that would share a title add how their logs were read."""
    titles = []
    for group in groups:
        alike = [other for other in groups if other.title == group.title]
        words = differing_options([other.log for other in alike])[alike.index(group)]
        titles.append(f"{group.title}: {', '.join(words)}" if words else group.title)
    return titles


def _reference(found: Sequence[Repeats], baseline: str | None) -> Repeats | None:
    """Return the variant with the baseline's name, or the only one with its label; None if there is none."""
    named = [variant for variant in found if variant.name == baseline]
    of_label = [variant for variant in found if variant.label == baseline]
    if not named and len(of_label) > 1:
        names = [variant.name for variant in of_label]
        raise ValueError(f"the baseline {baseline!r} has {len(names)} configurations: choose one of {names}")
    return next(iter(named or of_label), None)


def _sections(
    group: _Group, title: str, found: Sequence[Repeats], baseline: str | None, protocol: Protocol
) -> list[Section]:
    """Return the table of a group, and the one by camera if there are several cameras."""
    reference = _reference(found, baseline)
    ordered = sorted(found, key=lambda variant: (variant is not reference, variant.name))
    said = notes(ordered, group.over_scenes, protocol)
    if reference is not None and len(ordered) > 1:
        paired = "scene and seed" if group.over_scenes else "seed"
        said.append(f"differences are to {reference.name}, paired by {paired}; per cent is what remains of it")
    elif reference is None and baseline is not None:
        said.append(f"no run of the baseline {baseline} here, so no differences")

    def section(name: str, by_camera: bool, columns: tuple[Quantity, ...], said: list[str]) -> Section:
        rows = [_variant_row(variant, columns, group.over_scenes) for variant in ordered]
        if reference is not None:
            rows += [_difference_row(variant, reference, columns, group.over_scenes) for variant in ordered[1:]]
        return Section(name, group.over_scenes, by_camera, columns, tuple(rows), tuple(said))

    whole = section(title, False, quantities(group.runs, protocol), said)
    cameras = camera_quantities(group.runs)
    if not cameras:
        return [whole]
    # All other notes stand below the table that precedes it.
    said = [f"PSNR in dB of {_views(group.runs)}, the mean over the images of each camera; the rest as above"]
    return [whole, section(f"PSNR by camera, {title}", True, cameras, said)]


def _variant_row(variant: Repeats, columns: Sequence[Quantity], over_scenes: bool) -> Row:
    """Return mean and spread over runs, or over the means of each scene's runs."""
    frame = summary_frame(variant.runs)
    n = frame.groupby(UNIT[:2]).ngroups if over_scenes else len(frame)
    values = [of_runs(frame, one.column) for one in columns]
    cells = tuple(spread((by_scene(some) if over_scenes else some).tolist()) for some in values)
    runs = f"{n} scenes, n={len(frame)}" if over_scenes else _seeds(frame["seed"])
    return Row(variant.name, runs, n, cells, False, _capped(variant), _busy(frame, columns))


def _difference_row(variant: Repeats, reference: Repeats, columns: Sequence[Quantity], over_scenes: bool) -> Row:
    """Return differences between runs of the same scene and seed; several runs of one seed count as their mean."""
    frames = [summary_frame(one.runs).set_index(UNIT, drop=False) for one in (variant, reference)]
    shared = frames[0].index.unique().intersection(frames[1].index.unique())
    ours, theirs = (frame.loc[frame.index.isin(shared)].reset_index(drop=True) for frame in frames)
    n = len(shared.droplevel("seed").unique()) if over_scenes else len(shared)
    differences = [_differences(ours, theirs, quantity) for quantity in columns]
    cells = tuple(spread((by_scene(some) if over_scenes else some).tolist()) for some in differences)
    runs = f"{n} scenes, n={len(shared)}" if over_scenes else _seeds(shared.get_level_values("seed"))
    label = f"{variant.name} against {reference.name}"
    busy = _busy(pd.concat([ours, theirs]), columns)
    return Row(label, runs, n, cells, True, _capped(variant) or _capped(reference), busy)


def _differences(ours: pd.DataFrame, theirs: pd.DataFrame, quantity: Quantity) -> pd.Series:
    """Return scene, clip and seed -> the difference, or what remains in per cent; no time of a busy machine."""
    steady = [frame.loc[frame[quantity.clock]] if quantity.clock else frame for frame in (ours, theirs)]
    value, reference = (by_unit(frame, quantity.column) for frame in steady)
    found = 100 * value / reference[reference != 0] if quantity.relative else value - reference
    return found.dropna()


def _busy(frame: pd.DataFrame, columns: Sequence[Quantity]) -> tuple[bool, ...]:
    return tuple(bool(one.clock) and not all(frame[one.clock]) for one in columns)


def _seeds(seeds: Iterable[int]) -> str:
    known = sorted(seeds)
    return f"n={len(known)} (seed {','.join(map(str, known))})" if known else "no shared seed"


def _capped(variant: Repeats) -> bool:
    return any(run.run.caps for run in variant.runs)


_MAX_COLUMNS = 5
"""Largest number of variants and differences that stand in columns; more become rows if the terminal is wide enough."""


def section_tables(sections: Sequence[Section], width: int = 80) -> list[Table | Text]:
    """Return title, tables and notes of the sections for ``rich.console.Console``, ``width`` characters wide.

    Variants are columns, spread over as many tables as needed to cut no text. Many variants (a sweep) are rows if the
    terminal is wide enough.
    """
    return [part for section in sections for part in _drawn(section, width)]


def sections_markdown(sections: Sequence[Section]) -> str:
    """Return the sections as Markdown tables with notes; sections by camera have a row for each camera and region."""
    blocks = []
    for section in sections:
        lines = _lines(section)
        header, *lines = zip(*lines, strict=True) if section.by_camera else lines
        texts = 1 if section.by_camera else 2
        rule = ["---"] * texts + ["---:"] * (len(header) - texts)
        table = markdown_lines((header, rule, *lines))
        notes = "\n".join(f"- {note}" for note in section.notes)
        blocks.append(f"### {section.title}\n\n{table}\n\n{notes}\n")
    return "\n".join(blocks)


def _drawn(section: Section, width: int) -> list[Table | Text]:
    lines = _lines(section)
    if len(section.rows) > _MAX_COLUMNS and sum(map(_room, zip(*lines, strict=True))) < width:
        blocks = [lines]
    else:
        labels, *columns = lines
        blocks = [list(zip(labels, *some, strict=True)) for some in _fitting(columns, width - 1 - _room(labels))]
    # Texts, because rich would read the square brackets of strings as markup.
    title, notes = Text(section.title, style="bold"), Text("\n".join(section.notes) + "\n")
    return [title, *map(_table, blocks), notes]


def _fitting(columns: Sequence[Sequence[str]], width: int) -> list[list[Sequence[str]]]:
    """Return consecutive columns in groups that fit a width, at least one column in each."""
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
    """Return the width of a column in characters: its heading may break between words, its cells may not."""
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
    """Return header and rows as texts."""
    header = ["method", "runs", *(quantity.heading for quantity in section.quantities)]
    rows = [
        [row.label, row.runs, *(_cell(*one, row) for one in zip(row.cells, section.quantities, row.busy, strict=True))]
        for row in section.rows
    ]
    return [header, *rows]


def _cell(cell: Spread | None, quantity: Quantity, busy: bool, row: Row) -> str:
    """Return mean ± sd, marks of a count that a cap limited and of a time of a busy machine, and n if it differs.

    A difference holds no time of a busy machine: a dash has the mark where nothing else is left.
    """
    if cell is None:
        return LEFT_OUT if busy else ABSENT
    percentage = row.difference and quantity.relative
    number = ("{:.1f}" if percentage else quantity.text).format
    sign = "" if not row.difference or percentage else "+" if cell.mean >= 0 else "-"
    text = sign + number(abs(cell.mean) if sign else cell.mean)
    if cell.sd is not None:
        text += f" ± {number(cell.sd)}"
    text += " %" if percentage else ""
    text += f" {CAPPED}" if row.capped and quantity.count else ""
    text += f" {BUSY}" if busy and not row.difference else ""
    return text if cell.n == row.n else f"{text} (n={cell.n})"
