"""What a run paid for its effects, and what it got: the plan beside the measurement."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sparsestreet.atomic import atomic_file
from sparsestreet.records.costs import COSTS, CostRecord
from sparsestreet.records.run import RUN, EffectDecision

_ON, _OFF, _PREDICTED = "#3465a4", "#c8c8c8", "#555555"
_GAINS = (("full", "full image", "#3465a4"), ("vehicle", "vehicles", "#e07b00"), ("human", "people", "#4e9a06"))


def draw_effects(run: Path) -> None:
    """Writes ``pictures/effects.png``: a row for each effect of the plan, its milliseconds and its gain.

    A run without a plan or without measured costs gets no picture. Raises RecordError for a malformed record.
    """
    description, costs = RUN.find(run), COSTS.find(run)
    if description is None or costs is None or not description.effects:
        return
    plan = description.effects[::-1]  # the first on top
    figure = Figure(figsize=(9.0, 1.5 + 0.5 * len(plan)), layout="constrained")
    times, gains = figure.subplots(1, 2, sharey=True)
    _times(times, plan, costs)
    _gains(gains, plan, costs)
    times.set_yticks(range(len(plan)), [f"{one.name} ({'on' if one.on else 'off'}, {one.source})" for one in plan])
    figure.suptitle(f"{description.label} on {description.scene}: what the effects cost and bring", fontsize=10)
    with atomic_file(run / "pictures" / "effects.png") as file:
        figure.savefig(file, dpi=110)


def _times(axes: Axes, plan: Sequence[EffectDecision], costs: CostRecord) -> None:
    for row, one in enumerate(plan):
        axes.barh(row, costs.effects.get(one.name, 0.0), height=0.5, color=_ON if one.on else _OFF)
        axes.plot([one.ms, one.ms], [row - 0.3, row + 0.3], color=_PREDICTED, linestyle="-" if one.on else ":")
    axes.plot([], [], color=_PREDICTED, label="predicted")
    axes.legend(fontsize=7, loc="lower right")
    axes.set_xlabel("additional ms of a frame")


def _gains(axes: Axes, plan: Sequence[EffectDecision], costs: CostRecord) -> None:
    for row, one in enumerate(plan):
        gain = costs.gains.get(one.name)
        for place, (field, _, color) in enumerate(_GAINS):
            value = None if gain is None else getattr(gain, field)
            axes.barh(row + 0.2 - 0.2 * place, value or 0.0, height=0.18, color=color)
        if one.gain is not None:
            axes.plot([one.gain, one.gain], [row - 0.3, row + 0.3], color=_PREDICTED, linestyle="-" if one.on else ":")
    for _, label, color in _GAINS:
        axes.barh(0, 0.0, color=color, label=label)
    axes.legend(fontsize=7, loc="lower right")
    axes.set_xlabel("PSNR with the effect less without it, dB")
