"""Draws curves over training and the scatter of runs (matplotlib without a display)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

# Okabe and Ito's palette: distinguishable with any color vision.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
_MARKERS = "osD^vP*"  # one fewer than colors, so that pairs of both repeat late
_DASHES = ("--", ":", "-.")
_FEW_DECADES = 300
"""Ratio of the ends of an axis below which 2 and 5 times a power of ten have labels."""


def plot_counts(
    path: Path,
    steps: Sequence[int],
    counts: Mapping[str, Sequence[int]],
    events: Sequence[tuple[int, str]] = (),
    title: str = "Gaussians per node",
) -> None:
    """Draws the number of Gaussians of each node over training steps and marks events.

    Args:
        path: PNG to write.
        steps: training steps of the samples, increasing.
        counts: node -> number of Gaussians at each step (logarithmic axis; zeros are not drawn).
        events: (step, name), e.g. (2800, "pruning"); events of one name share a line style.
    """
    for name, values in counts.items():
        if len(values) != len(steps):
            raise ValueError(f"counts of {name!r} have {len(values)} samples, steps {len(steps)}: log them together")
    figure, axes = _figure(title, "step", "Gaussians")
    for index, (name, values) in enumerate(counts.items()):
        drawn = [(step, value) for step, value in zip(steps, values, strict=True) if value > 0]
        label = f"{name} ({values[-1]:,})" if len(values) else name
        # Counts jump at a step and stay. A slope between two samples would show Gaussians that never existed.
        samples = zip(*drawn, strict=True) if drawn else ([], [])
        axes.plot(*samples, label=label, drawstyle="steps-post", **_line(index))
    _mark(axes, events)
    axes.set_yscale("log")
    labels = FuncFormatter(lambda value, _: _short(value))
    axes.yaxis.set_major_formatter(labels)
    low, high = axes.get_ylim()
    # Within a decade or two the powers of ten are too few to read a count by.
    axes.yaxis.set_minor_formatter(labels if high < _FEW_DECADES * low else NullFormatter())
    axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    _finish(figure, axes, path)


def plot_psnr(
    path: Path,
    curves: Mapping[str, tuple[Sequence[int | float], Sequence[float]]],
    events: Sequence[tuple[int, str]] = (),
    title: str = "PSNR over training",
    along: str = "step",
) -> None:
    """Draws PSNR in dB over training steps, one curve per name -> (steps, PSNR), and marks (step, name) events.

    ``along`` names the horizontal axis.
    """
    figure, axes = _figure(title, along, "PSNR (dB)")
    for index, (name, (steps, values)) in enumerate(curves.items()):
        axes.plot(steps, values, label=name, **_line(index))
    _mark(axes, events)
    _finish(figure, axes, path)


def plot_runs(
    path: Path, points: Mapping[str, Sequence[tuple[int, float]]], title: str = "Quality against size"
) -> None:
    """Draws every run as a point; ``points``: name of a variant -> (Gaussians, held-out PSNR in dB) of its runs."""
    figure, axes = _figure(title, "Gaussians", "held-out PSNR, full image (dB)")
    for index, (name, runs) in enumerate(points.items()):
        gaussians, psnr = zip(*runs, strict=True)
        axes.scatter(
            gaussians,
            psnr,
            color=_COLORS[index % len(_COLORS)],
            marker=_MARKERS[index % len(_MARKERS)],
            s=46,
            alpha=0.85,
            label=f"{name} (n={len(runs)})",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.tick_params(axis="x", which="minor", labelsize=7)
    _finish(figure, axes, path)


def _figure(title: str, x_label: str, y_label: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.2, 4.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _mark(axes: Axes, events: Sequence[tuple[int, str]]) -> None:
    """Draws a vertical line at each event; events of one name share a style and an entry of the legend."""
    names = list(dict.fromkeys(name for _, name in events))
    style = {name: {"color": "0.55", "linewidth": 0.8, "linestyle": _DASHES[i % 3]} for i, name in enumerate(names)}
    for step, name in events:
        axes.axvline(step, zorder=0, **style[name])
    for name in names:
        axes.plot([], [], label=name, **style[name])


def _line(index: int) -> dict[str, Any]:
    return {"color": _COLORS[index % len(_COLORS)], "linewidth": 1.6}


def _short(value: float) -> str:
    """12000 -> 12k, 1500000 -> 1.5M."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}"


def _finish(figure: Figure, axes: Axes, path: Path) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
