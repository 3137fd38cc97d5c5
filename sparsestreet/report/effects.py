"""What each effect of a scene was predicted to cost, what it does cost, and what it brings."""

import statistics
from collections.abc import Callable, Sequence

from sparsestreet.records.costs import COSTS, CostRecord, EffectGain
from sparsestreet.records.effects import EffectDecision
from sparsestreet.report.arms import Arm
from sparsestreet.report.grid import ABSENT, Cell, Grid
from sparsestreet.report.notes import BUSY

_HEADER = (
    *(("", name) for name in ("arm", "effect", "state", "decided by", "value", "threshold")),
    *(("ms of a frame", name) for name in ("predicted", "measured")),
    ("", "MB"),
    *(("dB", name) for name in ("predicted", "full", "vehicles", "people")),
)


def what_effects_cost(arms: Sequence[Arm]) -> Grid:
    """Returns a row for each effect of each arm's plan; numbers are means over the arm's runs."""
    rows = [row for arm in arms for row in _rows(arm)]
    notes = [
        "measured: frames and PSNR of the finished scene with the effect, less those without it; a scene that was "
        "trained without the effect would have made up for a part"
    ]
    if busy := [arm.name for arm in arms if _busy([COSTS.find(record.folder) for record in arm.records])]:
        notes.append(f"{BUSY} times of a machine that was not quiet, compared with no other: {', '.join(busy)}")
    return Grid("effects", "What each effect costs and brings", _HEADER, tuple(rows), tuple(notes))


def effects_alike(arms: Sequence[Arm]) -> str | None:
    """Returns which effects are on, in a sentence, if they are the same in all arms; None if arms differ in them."""
    plans = {tuple((one.name, one.on) for one in record.summary.run.effects) for arm in arms for record in arm.records}
    if len(plans) != 1:
        return None
    on = [name for name, is_on in next(iter(plans)) if is_on]
    return f"all arms have the same effects ({', '.join(on) or 'none'})"


def _rows(arm: Arm) -> list[tuple[Cell, ...]]:
    plans = [{one.name: one for one in record.summary.run.effects} for record in arm.records]
    costs = [COSTS.find(record.folder) for record in arm.records]
    runs = tuple(record.folder.name for record in arm.records)
    names = list(dict.fromkeys(name for plan in plans for name in plan))
    return [
        tuple(Cell(text, runs=runs) for text in (arm.title, *_cells(name, [plan[name] for plan in plans], costs)))
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
        f"{_text(measured, '{:.2f}')} {BUSY if _busy(costs) and any(measured) else ''}".rstrip(),
        _text([4e-6 * one.numbers for one in found], "{:.3g}"),
        _text([one.gain for one in found], "{:+.2f}"),
        *(_gain(gains, of) for of in (lambda gain: gain.full, lambda gain: gain.vehicle, lambda gain: gain.human)),
    ]


def _busy(costs: Sequence[CostRecord | None]) -> bool:
    """Returns whether a machine was not quiet while frames were timed with and without each effect."""
    return any(cost is not None and cost.noise is not None and not cost.noise.quiet for cost in costs)


def _gain(gains: Sequence[EffectGain | None], of: Callable[[EffectGain], float | None]) -> str:
    return _text([None if gain is None else of(gain) for gain in gains], "{:+.2f}")


def _text(values: Sequence[float | None], form: str) -> str:
    mean = _mean(values)
    return ABSENT if mean is None else form.format(mean)


def _mean(values: Sequence[float | None]) -> float | None:
    given = [value for value in values if value is not None]
    return statistics.fmean(given) if given else None
