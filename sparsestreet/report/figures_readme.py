"""One figure of a sweep for a README: quality against training time, and against the time of a frame."""

import statistics
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.quality import HELD_OUT
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.arms import Arm, Value, by_scene
from sparsestreet.report.curves import curves_of, mean_curve
from sparsestreet.report.figures import legend_below, panels, styles

_DASHES = {"plain": "-", "paper": "--", "paper_short": "--", "removal": ":"}


def time_figure(arms: Sequence[Arm], protocol: Protocol, path: Path) -> None:
    """Writes a PNG: held-out PSNR over training seconds and over milliseconds a frame, without controls.

    Curves are means over scenes and seeds at each look. Without curves, only the end of training is drawn. Raises
    ValueError if no run has a held-out PSNR.
    """
    shown = [arm for arm in arms if not arm.control and arm.mean(_psnr(protocol)) is not None]
    if not shown:
        raise ValueError("no run was evaluated on held-out views, which the figure shows: train with split.stride > 0")
    figure, (training, frame) = panels(2, width=4.6, height=4.0)
    for arm in shown:
        _over_training(training, arm, shown, protocol)
        _points(frame, arm, shown, lambda run: run.latency.p50, protocol)
    training.set_xlabel("training seconds")
    frame.set_xlabel("milliseconds a frame")
    training.set_ylabel("held-out PSNR, dB")
    legend_below(figure, training.get_legend_handles_labels()[0])
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white", metadata={"Software": None})


def _psnr(protocol: Protocol) -> Value:
    return lambda run: run.mean(protocol.psnr, HELD_OUT)


def _over_training(axes: Axes, arm: Arm, shown: Sequence[Arm], protocol: Protocol) -> None:
    curves = list(curves_of(arm).values())
    if not curves:
        _points(axes, arm, shown, _seconds, protocol)
        return
    mean = mean_curve(curves)
    look, end = styles(shown)[arm.name], [len(mean.seconds) - 1]
    dashes = _DASHES.get(look.kind, "-.")
    paint = _paint(arm, shown)
    axes.plot(
        mean.seconds, mean.psnr, color=paint, linestyle=dashes, marker=look.marker, markevery=end, label=_label(arm)
    )


def _paint(arm: Arm, shown: Sequence[Arm]) -> str:
    """Returns the color of the arm's method, or of its sparsification if there is only one method."""
    look = styles(shown)
    own = look[arm.name]
    return own.method if len({one.method for one in look.values()}) > 1 else own.color


def _points(axes: Axes, arm: Arm, shown: Sequence[Arm], cost: Value, protocol: Protocol) -> None:
    """Draws the mean, and every run small and pale."""
    costs, qualities = arm.units(cost), arm.units(_psnr(protocol))
    units = sorted(costs.keys() & qualities.keys())
    if not units:
        return
    paint = _paint(arm, shown)
    axes.scatter([costs[unit] for unit in units], [qualities[unit] for unit in units], s=8, color=paint, alpha=0.5)
    scenes = (by_scene({unit: values[unit] for unit in units}) for values in (costs, qualities))
    x, y = (statistics.fmean(means.values()) for means in scenes)
    axes.scatter(x, y, s=44, color=paint, marker=styles(shown)[arm.name].marker, label=_label(arm), zorder=3)


def _label(arm: Arm) -> str:
    return f"{arm.title} (machine not quiet)" if arm.busy("frames") or arm.busy("training") else arm.title


def _seconds(run: RunSummary) -> float | None:
    return run.run.training_seconds
