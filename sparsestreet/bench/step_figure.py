"""The picture of a training step: one bar per phase, with its floor inside."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sparsestreet.bench.figures import save_figure
from sparsestreet.bench.step_record import StepRecord

_OP, _REST, _FLOOR = "#0072B2", "#E69F00", "#333333"


def draw_step(record: StepRecord, folder: Path) -> list[Path]:
    """Draws median milliseconds of each phase that takes at least a hundredth of the step, the longest on top."""
    shown = [phase for phase in record.phases if phase.time.median >= 0.01 * record.step.median]
    figure = Figure(figsize=(8.0, 1.3 + 0.34 * len(shown)), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for place, phase in enumerate(shown):
        color = _OP if phase.name.startswith("splat") else _REST
        axes.barh(place, phase.time.median, color=color, height=0.72)
        if phase.floor_ms is not None:
            axes.barh(place, phase.floor_ms, color=_FLOOR, height=0.22)
        distance = "" if not phase.floor_ms else f", {phase.time.median / phase.floor_ms:.1f} x its floor"
        text = f" {phase.time.median:.1f} ms, {phase.operations:.0f} operations{distance}"
        axes.annotate(text, (phase.time.median, place), va="center", fontsize=8)
    axes.set_yticks(range(len(shown)), [phase.name for phase in shown])
    axes.invert_yaxis()
    axes.set_xlim(right=1.55 * max(phase.time.median for phase in shown))
    axes.set_xlabel("median milliseconds; black: floor (bytes over bandwidth, operations over peak)")
    axes.set_title(
        f"{record.what}: {record.step.median:.1f} ms a step, {record.ratio:.2f} x its op, "
        f"{record.operations:.0f} operations",
        fontsize=10,
    )
    axes.spines[["top", "right"]].set_visible(False)
    return save_figure(figure, folder, "step")
