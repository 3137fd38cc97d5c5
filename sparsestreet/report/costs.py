"""What was measured beside the quality of held-out views: size, time, effects, and renders off the path."""

import math
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.costs import COSTS, CostRecord
from sparsestreet.records.curves import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.run import EffectDecision
from sparsestreet.records.summary import PRESETS
from sparsestreet.report.collect import TRUTH, UNIT, by_unit, mean_over_scenes, shifts_of
from sparsestreet.report.tables import ABSENT, BUSY, Cell, Grid, busy_words, number_cell
from sparsestreet.report.tradeoffs import difference_cell, spread_over_scenes
from sparsestreet.report.variants import Unit, Variant, busy_variants, plain_of

_CLOCK_OF = {"ms/frame": "frames", "train s": "training"} | dict.fromkeys(("seconds", "ms of a step"), "training")
"""Heading, or shared heading, of a column of times -> what its machine was measured with."""

_COLUMNS = (
    ("", "Gaussians", "{:,.0f}"),
    ("", "MB", "{:.2f}"),
    ("", "ms/frame", "{:.2f}"),
    ("", "train s", "{:.1f}"),
    ("seconds", "pruning", "{:.1f}"),
    ("seconds", "whole command", "{:.0f}"),
    *(("ms of a step", part, "{:.1f}") for part in ("forward", "backward", "optimizer")),
    ("peak MB", "host", "{:.0f}"),
    ("peak MB", "GPU", "{:.0f}"),
)
"""Shared heading, heading (which is the column of ``run_frame``) and format."""


def what_variants_cost(variants: Sequence[Variant]) -> Grid:
    """Return size, speed, time and memory of every variant, as means over its runs."""
    names = [heading for _, heading, _ in _COLUMNS]
    means = {
        variant.name: {name: _mean(numbers) for name, numbers in variant.frame.reindex(columns=names).items()}
        for variant in variants
    }
    shown = [column for column in _COLUMNS if any(one[column[1]] is not None for one in means.values())]
    rows = []
    for variant in variants:
        runs = variant.run_names
        clocks = [_CLOCK_OF.get(group or heading) for group, heading, _ in shown]
        cells = [
            number_cell(means[variant.name][heading], form, runs, variant.busy(clock) if clock else "")
            for (_, heading, form), clock in zip(shown, clocks, strict=True)
        ]
        rows.append((Cell(variant.title, runs=runs), Cell(str(len(runs)), runs=runs), *cells))
    header = (("", "arm"), ("", "n"), *((group, heading) for group, heading, _ in shown))
    notes = [
        "means over the runs of an arm; train s: steps and pruning, without evaluation; whole command: from the import "
        "of torch to the pictures; a step: medians over the steps that records/phases.csv notes"
    ]
    return Grid("costs", "What each arm costs", header, tuple(rows), (*notes, *busy_variants(variants)))


_HEADER = (
    *(("", name) for name in ("arm", "effect", "state", "decided by", "value", "threshold")),
    *(("ms of a frame", name) for name in ("predicted", "measured")),
    ("", "MB"),
    *(("dB", name) for name in ("predicted", "full", "vehicles", "people")),
)


def what_effects_cost(variants: Sequence[Variant]) -> Grid:
    """Return a row for each effect of each variant's plan; numbers are means over the variant's runs."""
    rows = [row for variant in variants for row in _rows(variant)]
    notes = [
        "measured: frames and PSNR of the finished scene with the effect, less those without it; a scene that was "
        "trained without the effect would have made up for a part"
    ]
    busy = [
        variant.name for variant in variants if timed_busy([COSTS.find(record.folder) for record in variant.records])
    ]
    notes += busy_words(", ".join(busy))
    return Grid("effects", "What each effect costs and brings", _HEADER, tuple(rows), tuple(notes))


def effects_alike(variants: Sequence[Variant]) -> str | None:
    """Return which effects are on, in a sentence, if all variants have the same ones; None if they differ."""
    plans = {
        tuple((one.name, one.on) for one in record.summary.run.effects)
        for variant in variants
        for record in variant.records
    }
    if len(plans) != 1:
        return None
    on = [name for name, is_on in next(iter(plans)) if is_on]
    return f"all arms have the same effects ({', '.join(on) or 'none'})"


def _rows(variant: Variant) -> list[tuple[Cell, ...]]:
    plans = [{one.name: one for one in record.summary.run.effects} for record in variant.records]
    costs = [COSTS.find(record.folder) for record in variant.records]
    runs = variant.run_names
    names = list(dict.fromkeys(name for plan in plans for name in plan))
    return [
        tuple(Cell(text, runs=runs) for text in (variant.title, *_cells(name, [plan[name] for plan in plans], costs)))
        for name in names
        if all(name in plan for plan in plans)
    ]


def _cells(name: str, found: Sequence[EffectDecision], costs: Sequence[CostRecord | None]) -> list[str]:
    first, on = found[0], sum(one.on for one in found)
    measured = [None if cost is None else cost.effects.get(name) for cost in costs]
    gains = [None if cost is None else cost.gains.get(name) for cost in costs]
    state = ("on" if on else "off") if on in (0, len(found)) else f"on in {on} of {len(found)}"
    value = _mean([one.value for one in found])
    return [
        name,
        state,
        ", ".join(dict.fromkeys(one.source for one in found)),
        ABSENT if value is None else f"{value:.3g} {first.unit}",
        ABSENT if first.threshold is None else f"{first.threshold:g}",
        _text([one.ms for one in found], "{:.2f}"),
        f"{_text(measured, '{:.2f}')} {BUSY if timed_busy(costs) and any(measured) else ''}".rstrip(),
        _text([4e-6 * one.numbers for one in found], "{:.3g}"),
        _text([one.gain for one in found], "{:+.2f}"),
        *(_text([gain and getattr(gain, of) for gain in gains], "{:+.2f}") for of in ("full", "vehicle", "human")),
    ]


def timed_busy(costs: Sequence[CostRecord | None]) -> bool:
    """Return whether a machine was not quiet while frames were timed with and without each effect."""
    return any(cost is not None and cost.noise is not None and not cost.noise.quiet for cost in costs)


def _text(values: Sequence[float | None], form: str) -> str:
    mean = _mean(values)
    return ABSENT if mean is None else form.format(mean)


def _mean(values: Iterable[float | None]) -> float | None:
    given = [value for value in values if value is not None and not math.isnan(value)]
    return statistics.fmean(given) if given else None


BELOW = (1.0, 0.5, 0.1)
"""Qualities whose time is reported, dB below the last quality of the plain run."""


@dataclass(frozen=True)
class QualityCurve:
    """The probe of held-out views of one run, or the mean of several runs."""

    seconds: tuple[float, ...]
    """Seconds of training without evaluation."""
    psnr: tuple[float, ...]
    """Full image, dB."""


def curves_of_runs(variant: Variant) -> dict[Unit, list[QualityCurve]]:
    """Return scene and seed -> the curves of its runs, for the runs that hold views out and have a curve."""
    found = {
        unit: [_curve(HELD_OUT_CURVE.find(run.folder) or ()) for run in runs] for unit, runs in variant.runs().items()
    }
    known = {unit: [curve for curve in curves if curve.seconds] for unit, curves in found.items()}
    return {unit: curves for unit, curves in known.items() if curves}


def curves_of(variant: Variant) -> dict[Unit, QualityCurve]:
    """Return scene and seed -> the curve of its run, or the mean of several runs."""
    return {unit: mean_curve(curves) for unit, curves in curves_of_runs(variant).items()}


def mean_curve(curves: Sequence[QualityCurve]) -> QualityCurve:
    """Return mean seconds and mean dB at each look that all curves have.

    >>> mean_curve([QualityCurve((10.0, 20.0), (22.0, 25.0)), QualityCurve((14.0,), (24.0,))])
    QualityCurve(seconds=(12.0,), psnr=(23.0,))
    """
    looks = range(min(len(curve.seconds) for curve in curves))
    seconds = tuple(statistics.fmean(curve.seconds[look] for curve in curves) for look in looks)
    return QualityCurve(seconds, tuple(statistics.fmean(curve.psnr[look] for curve in curves) for look in looks))


def _curve(looks: Sequence[HeldOutLook]) -> QualityCurve:
    points = [(look.seconds, look.psnr_full) for look in looks if look.psnr_full is not None]
    return QualityCurve(tuple(at for at, _ in points), tuple(psnr for _, psnr in points))


def seconds_to(curve: QualityCurve, psnr: float) -> float | None:
    """Return the training seconds at the first look with at least this PSNR, or None; looks are not interpolated.

    >>> seconds_to(QualityCurve(seconds=(10.0, 20.0), psnr=(22.0, 25.0)), 24.0)
    20.0
    """
    return next((at for at, value in zip(curve.seconds, curve.psnr, strict=True) if value >= psnr), None)


def time_to_quality(variants: Sequence[Variant]) -> Grid | None:
    """Return median seconds to the plain run's last PSNR minus 1, 0.5 and 0.1 dB; None if no run has a curve."""
    curves = {variant.name: curves_of(variant) for variant in variants}
    if not any(curves.values()):
        return None
    rows = []
    for variant in variants:
        plain = plain_of(variant, variants)
        if plain is None or not curves[variant.name]:
            continue
        runs = variant.run_names
        times = [_reached(curves[variant.name], curves[plain.name], below) for below in BELOW]
        cells = [
            Cell(f"{time} {variant.busy('training') if ' s' in time else ''}".rstrip(), runs=runs) for time in times
        ]
        rows.append((Cell(variant.title, runs=runs), *cells))
    header = (("", "arm"), *(("", f"base - {below:g} dB") for below in BELOW))
    notes = (
        "training seconds, evaluation left out, to the first look at held-out views that is as good: the median of the "
        "runs that get there; base: the last look of the plain run of the same scene and seed",
        "a look is a fixed probe of held-out views; nothing is interpolated between two looks",
    )
    return Grid("time_to_quality", "Time to quality", header, tuple(rows), (*notes, *busy_variants(variants)))


def _reached(ours: dict[Unit, QualityCurve], plain: dict[Unit, QualityCurve], below: float) -> str:
    shared = ours.keys() & plain.keys()
    times = [seconds_to(ours[unit], plain[unit].psnr[-1] - below) for unit in shared]
    reached = [time for time in times if time is not None]
    if not reached:
        return "not reached" if shared else "-"
    text = f"{statistics.median(reached):.1f} s"
    return text if len(reached) == len(times) else f"{text} ({len(reached)} of {len(times)})"


_PLACES = {title: place for place, title in enumerate(TRUTH.values())}


def mean_beside(variant: Variant, column: str) -> float | None:
    """Return the mean of a variant in which each scene counts once; None if no run has the number.

    Runs that were trained on all views count only if no run that holds views out has the number.
    """
    held = variant.mean(column)
    return variant.mean(column, whole=True) if held is None else held


def beside_the_path(variants: Sequence[Variant]) -> Grid | None:
    """Return PSNR and LPIPS to the truth and every recorded distance, by meters; None if no run recorded any."""
    measured = [shifts_of(record.folder) for variant in variants for record in variant.records]
    found = {(name, meters) for shifts in measured for meters, numbers in shifts.items() for name in numbers}
    columns = sorted(found, key=lambda column: (column[0] not in _PLACES, _PLACES.get(column[0], 0), column))
    if not columns:
        return None
    rows = []
    for variant in variants:
        runs = variant.run_names
        means = [mean_beside(variant, f"{name} at {meters:g} m") for name, meters in columns]
        cells = [
            Cell() if mean is None else Cell(f"{mean:.2f}" if name.endswith("dB") else f"{mean:.4g}", runs=runs)
            for (name, _), mean in zip(columns, means, strict=True)
        ]
        rows.append((Cell(variant.title, runs=runs), *cells))
    header = (("", "arm"), *((name, f"{meters:g} m") for name, meters in columns))
    notes = (
        "mean of both sides; a distance of image sets is biased by their number, so that it compares arms of one sweep "
        "and says nothing by its level; only that of Inception's features is the published FID",
    )
    return Grid("beside", "Beside the recorded path", header, tuple(rows), notes)


_REGIONS = ("full", "human", "vehicle")
_COSTS = (("", "dB to exact", "{:.1f}"), ("", "ms/frame", "{:.2f}"))


def rendered_otherwise(variants: Sequence[Variant], protocol: Protocol) -> Grid | None:
    """Return a row for each variant and preset that its runs have; None if no run has any.

    Raises RecordError for a malformed record.
    """
    recorded = [(variant, _renders(variant)) for variant in variants]
    labels = Counter(variant.label for variant in variants)
    rows = [
        row
        for variant, records in recorded
        for row in _preset_rows(variant, records, protocol, labels[variant.label] > 1)
    ]
    if not rows:
        return None
    header = [("", "trained"), ("", "rendered"), ("", "n")]
    header += [(f"PSNR {region}", what) for region in _REGIONS for what in ("dB", "- as trained")]
    header += [(group, heading) for group, heading, _ in _COSTS]
    notes = [
        "one scene, the same held-out views; dB to exact: of the image against that of the same scene without cut-off "
        "and early stop; differences paired by scene and seed, with 95 % t intervals, bold where they exclude 0"
    ]
    notes += busy_words(", ".join(variant.name for variant, records in recorded if _busy_renders(records)))
    return Grid("presets", "Trained one way, rendered another", tuple(header), tuple(rows), tuple(notes))


def _renders(variant: Variant) -> pd.DataFrame:
    """Return a row for each way in which runs that hold views out were rendered; else of runs trained on all views."""
    rows = []
    for record, run in zip(variant.records, variant.frame.to_dict("records"), strict=True):
        found = PRESETS.find(record.folder)
        rendered, quiet = (found.rendered, found.noise.quiet) if found else ((), True)
        for one in rendered:
            own = {"preset": one.preset, "trained": one.trained, "quiet": quiet}
            numbers = {"dB to exact": one.psnr_to_exact, "ms/frame": one.frame_ms}
            rows.append({name: run[name] for name in (*UNIT, "whole")} | own | numbers | one.quality)
    renders = pd.DataFrame(rows, columns=None if rows else [*UNIT, "whole", "preset", "trained", "quiet"])
    held = renders.loc[~renders["whole"].astype(bool)]
    return renders if held.empty else held


def _preset_rows(
    variant: Variant, renders: pd.DataFrame, protocol: Protocol, several: bool
) -> Iterator[tuple[Cell, ...]]:
    """Yield a row for each preset; the preset of training tells ``several`` variants of a label apart."""
    runs = variant.run_names
    trained = renders.loc[renders["trained"].astype(bool)]
    presets = sorted(set(trained["preset"]))
    title = f"{variant.label}, {presets[0]}" if several and len(presets) == 1 else variant.title
    for preset in dict.fromkeys(renders["preset"]):
        found = renders.loc[renders["preset"] == preset]
        n = found.groupby(UNIT).ngroups
        name = f"{preset}, as trained" if all(found["trained"]) else preset
        cells = [Cell(title, runs=runs), Cell(name, runs=runs), Cell(str(n), runs=runs)]
        for metric in (protocol.psnr, protocol.human[0], protocol.vehicle[0]):
            ours, theirs = by_unit(found, metric), by_unit(trained, metric)
            gain = None if found.equals(trained) else spread_over_scenes((ours - theirs).dropna())
            cells.append(number_cell(mean_over_scenes(ours), "{:.2f}", runs))
            cells.append(difference_cell(gain, "{:+.2f}", n, runs))
        for _, heading, form in _COSTS:
            mark = _busy_renders(renders) if heading == "ms/frame" else ""
            cells.append(number_cell(mean_over_scenes(by_unit(found, heading)), form, runs, mark))
        yield tuple(cells)


def _busy_renders(renders: pd.DataFrame) -> str:
    """Return the mark of milliseconds if a machine was not quiet; else an empty text."""
    return "" if all(renders["quiet"]) else BUSY
