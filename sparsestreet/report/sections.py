"""Sections of a report, a table each: rows of repeats, differences to a baseline, and means over scenes."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sparsestreet.metrics.definitions import DRIVESTUDIO, Protocol
from sparsestreet.records.configuration import Setting, config_hash, differing_options, only, without
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.collect import RunRecord, check_definitions
from sparsestreet.report.notes import camera_notes, notes
from sparsestreet.report.quantities import Quantity, camera_quantities, quantities
from sparsestreet.report.spread import Spread, spread
from sparsestreet.report.variants import CLIP_KEYS, Variant, log_config, variants


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
    busy: tuple[bool, ...] = ()
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
    """Returns a section for each scene, split and resolution, then sections of means over scenes.

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
    parted = [variants(group.runs, runs) for group in groups]
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
        several = [variant for variant in variants(group) if len({run.run.scene for run in variant.runs}) > 1]
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
    """Returns each group's title; groups that would share a title add how their logs were read."""
    titles = []
    for group in groups:
        alike = [other for other in groups if other.title == group.title]
        words = differing_options([other.log for other in alike])[alike.index(group)]
        titles.append(f"{group.title}: {', '.join(words)}" if words else group.title)
    return titles


def _reference(found: Sequence[Variant], baseline: str | None) -> Variant | None:
    """Returns the variant with the baseline's name, or the only one with its label; None if there is none."""
    named = [variant for variant in found if variant.name == baseline]
    of_label = [variant for variant in found if variant.label == baseline]
    if not named and len(of_label) > 1:
        names = [variant.name for variant in of_label]
        raise ValueError(f"the baseline {baseline!r} has {len(names)} configurations: choose one of {names}")
    return next(iter(named or of_label), None)


def _sections(
    group: _Group, title: str, found: Sequence[Variant], baseline: str | None, protocol: Protocol
) -> list[Section]:
    """Returns the table of a group, and the one by camera if there are several cameras."""
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
    return [whole, section(f"PSNR by camera, {title}", True, cameras, camera_notes(ordered))]


def _variant_row(variant: Variant, columns: Sequence[Quantity], over_scenes: bool) -> Row:
    """Returns mean and spread over runs, or over the means of each scene's runs."""
    units = _units(variant.runs, _clip) if over_scenes else [[run] for run in variant.runs]
    cells = [_spread_of([[quantity.value(run) for run in unit] for unit in units]) for quantity in columns]
    runs = (
        f"{len(units)} scenes, n={len(variant.runs)}" if over_scenes else _seeds(run.run.seed for run in variant.runs)
    )
    return Row(variant.name, runs, len(units), tuple(cells), False, _capped(variant), _busy(variant.runs, columns))


def _difference_row(variant: Variant, reference: Variant, columns: Sequence[Quantity], over_scenes: bool) -> Row:
    """Returns differences between runs of the same scene and seed; several runs of one seed count as their mean."""
    ours, theirs = (
        {_clip_and_seed(unit[0]): unit for unit in _units(one.runs, _clip_and_seed)} for one in (variant, reference)
    )
    shared = sorted(ours.keys() & theirs.keys())
    units: dict[object, list[tuple[str, str, int]]] = {}
    for key in shared:
        units.setdefault(key[:2] if over_scenes else key, []).append(key)
    cells = [
        _spread_of([[_difference(ours[key], theirs[key], quantity) for key in unit] for unit in units.values()])
        for quantity in columns
    ]
    runs = f"{len(units)} scenes, n={len(shared)}" if over_scenes else _seeds(seed for *_, seed in shared)
    label = f"{variant.name} against {reference.name}"
    busy = _busy([run for key in shared for run in (*ours[key], *theirs[key])], columns)
    return Row(label, runs, len(units), tuple(cells), True, _capped(variant) or _capped(reference), busy)


def _busy(runs: Iterable[RunSummary], columns: Sequence[Quantity]) -> tuple[bool, ...]:
    runs = list(runs)
    return tuple(not all(quantity.steady(run) for run in runs) for quantity in columns)


def _clip(run: RunSummary) -> tuple[str, str]:
    """Returns what identifies a scene: the log, and the part of it that was read."""
    return run.run.scene, config_hash(only(run.run.config, CLIP_KEYS))


def _clip_and_seed(run: RunSummary) -> tuple[str, str, int]:
    return *_clip(run), run.run.seed


def _units(runs: Iterable[RunSummary], key: Callable[[RunSummary], object]) -> list[list[RunSummary]]:
    units: dict[object, list[RunSummary]] = {}
    for run in runs:
        units.setdefault(key(run), []).append(run)
    return list(units.values())


def _spread_of(units: Iterable[Iterable[float | None]]) -> Spread | None:
    """Returns the spread over units; each unit counts as the mean of its values."""
    means = [spread([value for value in unit if value is not None]) for unit in units]
    return spread([unit.mean for unit in means if unit is not None])


def _difference(runs: Sequence[RunSummary], others: Sequence[RunSummary], quantity: Quantity) -> float | None:
    value, reference = (
        _spread_of([quantity.value(run)] for run in some if quantity.steady(run)) for some in (runs, others)
    )
    if value is None or reference is None or (quantity.relative and reference.mean == 0):
        return None
    return 100 * value.mean / reference.mean if quantity.relative else value.mean - reference.mean


def _seeds(seeds: Iterable[int]) -> str:
    known = sorted(seeds)
    return f"n={len(known)} (seed {','.join(map(str, known))})" if known else "no shared seed"


def _capped(variant: Variant) -> bool:
    return any(run.run.caps for run in variant.runs)
