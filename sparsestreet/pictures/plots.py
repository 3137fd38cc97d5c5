"""Draws curves over training and the scatter of runs (matplotlib without a display)."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparsestreet.atomic import atomic_file
from sparsestreet.pictures.images import Dots, Marked, Panel, Places
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, LOGGED, MASK, PRUNING, CountChange
from sparsestreet.records.run import RUN

# Okabe and Ito's palette: distinguishable with any color vision.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
_DASHES = ("--", ":", "-.")
_MAX_FULL_TICKS = 300
"""Ratio of the ends of an axis below which 2 and 5 times a power of ten have labels."""


def plot_counts(
    path: Path,
    steps: Sequence[int],
    counts: Mapping[str, Sequence[int]],
    events: Sequence[tuple[int, str]] = (),
) -> None:
    """Draw the number of Gaussians of each node over training steps and marks events.

    Args:
        path: PNG to write.
        steps: training steps of the samples, increasing.
        counts: node -> number of Gaussians at each step (logarithmic axis; zeros are not drawn).
        events: (step, name), e.g. (2800, "pruning"); events of one name share a line style.
    """
    figure, axes = _figure("Gaussians per node", "step", "Gaussians")
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
    axes.yaxis.set_minor_formatter(labels if high < _MAX_FULL_TICKS * low else NullFormatter())
    axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    _finish(figure, axes, path)


def plot_psnr(
    path: Path,
    curves: Mapping[str, tuple[Sequence[int | float], Sequence[float]]],
    events: Sequence[tuple[int, str]] = (),
    title: str = "PSNR over training",
    along: str = "step",
) -> None:
    """Draw PSNR in dB over training steps, one curve per name -> (steps, PSNR), and marks (step, name) events.

    ``along`` names the horizontal axis.
    """
    figure, axes = _figure(title, along, "PSNR (dB)")
    for index, (name, (steps, values)) in enumerate(curves.items()):
        axes.plot(steps, values, label=name, **_line(index))
    _mark(axes, events)
    _finish(figure, axes, path)


def _figure(title: str, x_label: str, y_label: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.2, 4.2), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _mark(axes: Axes, events: Sequence[tuple[int, str]]) -> None:
    """Draw a vertical line at each event; events of one name share a style and an entry of the legend."""
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


MARKED = (MASK, PRUNING)
"""Reasons of the changes that the curves mark."""

PSNR_COLUMNS = {"training, running mean": "psnr", "held out": "val/psnr"}
"""Curve -> its column in ``curves/metrics.csv``."""


_NOT_HELD_OUT = "PSNR over training (no look at held-out views: trainer.val_check_interval, split.stride)"

HELD_OUT_COLUMNS = {"full image": "psnr_full", "humans": "psnr_human", "vehicles": "psnr_vehicle"}
"""Curve -> its column in ``curves/held_out.csv``."""


def draw_history(run: Path) -> None:
    """Write ``counts.png``, ``psnr.png`` and ``held_out.png`` to the run's folder ``curves``.

    They show ``records/counts.csv``, ``curves/metrics.csv`` and ``curves/held_out.csv``. A run without one of these
    files gets no picture of it. Raises RecordError for a malformed file.
    """
    changes = LEDGER.find(run)
    events = marks(changes or ())
    if changes is not None:
        steps, counts = _to_the_end(*count_curves(changes), run)
        plot_counts(run / "curves" / "counts.png", steps, counts, events)
    curves = psnr_curves(LOGGED.rows(run), PSNR_COLUMNS, "step")
    if curves:
        title = "PSNR over training" if "held out" in curves else _NOT_HELD_OUT
        plot_psnr(run / "curves" / "psnr.png", curves, events, title)
    curves = psnr_curves([asdict(look) for look in HELD_OUT_CURVE.find(run) or ()], HELD_OUT_COLUMNS, "seconds")
    if curves:
        title = "Held-out PSNR over training time, without evaluation"
        plot_psnr(run / "curves" / "held_out.png", curves, (), title, "seconds")


def _to_the_end(steps: list[int], counts: dict[str, list[int]], run: Path) -> tuple[list[int], dict[str, list[int]]]:
    """Return the curves with the run's last step, at which nothing need have changed."""
    known = RUN.find(run)
    if known is None or not steps or known.steps <= steps[-1]:
        return steps, counts
    return [*steps, known.steps], {name: [*series, series[-1]] for name, series in counts.items()}


def count_curves(changes: Sequence[CountChange]) -> tuple[list[int], dict[str, list[int]]]:
    """Return the steps at which any node changes, and node -> its number of Gaussians after each of these steps.

    >>> count_curves([CountChange(0, "road", 0, 9, "start"), CountChange(5, "cars", 0, 4, "start")])
    ([0, 5], {'road': [9, 9], 'cars': [0, 4]})
    """
    steps = sorted({change.step for change in changes})
    curves: dict[str, list[int]] = {change.node: [] for change in changes}
    for node, series in curves.items():
        # The ledger is in order, so the last of several changes in one step counts.
        after = {change.step: change.after for change in changes if change.node == node}
        gaussians = 0
        for step in steps:
            gaussians = after.get(step, gaussians)
            series.append(gaussians)
    return steps, curves


def marks(changes: Sequence[CountChange]) -> list[tuple[int, str]]:
    """Return (step, reason) of the changes that make the scene small, each once, in order.

    >>> marks([CountChange(0, "road", 0, 9, "start"), CountChange(8, "road", 9, 6, PRUNING)])
    [(8, 'pruning')]
    """
    return list(dict.fromkeys((change.step, change.reason) for change in changes if change.reason in MARKED))


def psnr_curves(
    rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], along: str
) -> dict[str, tuple[Sequence[int | float], Sequence[float]]]:
    """Return name of a curve -> (steps or seconds, dB), from the rows that have a value.

    >>> psnr_curves([{"step": 1.0, "psnr": 20.5}, {"step": 2.0, "psnr": None}], {"training": "psnr"}, "step")
    {'training': ((1.0,), (20.5,))}
    """
    curves = {}
    for label, column in columns.items():
        points = [(float(row[along]), float(row[column])) for row in rows if row.get(column) not in (None, "")]
        if points:
            curves[label] = tuple(zip(*points, strict=True))
    return curves


COLUMNS = 2
_MARK = np.array([230.0, 40.0, 40.0])


def draw_evidence(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Write a PNG with a cell for each panel. Raises ValueError without any."""
    if not panels:
        raise ValueError("a picture of evidence needs a panel, and no effect has one")
    lines = -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(12.0, 0.5 + 3.3 * lines), dpi=100, layout="constrained")
    cells = figure.subplots(lines, COLUMNS, squeeze=False).flat
    for axes, panel in zip(cells, panels, strict=False):
        axes.set_title(panel.title, fontsize=9)
        _draw(axes, panel)
    for axes in list(figure.axes)[len(panels) : lines * COLUMNS]:
        axes.set_axis_off()
    figure.suptitle(title, fontsize=11)
    with atomic_file(path) as file:
        figure.savefig(file, format="png")


def _draw(axes: Axes, panel: Panel) -> None:
    match panel:
        case Dots():
            _dots(axes, panel)
        case Marked(_, image, mask):
            axes.imshow(np.where(mask[..., None], 0.4 * image + 0.6 * _MARK, image).astype(np.uint8))
            axes.set_axis_off()
        case Places(_, image, pixels, values, unit):
            axes.imshow(image, alpha=0.5)
            drawn = axes.scatter(pixels[:, 0], pixels[:, 1], c=values, s=6, cmap="viridis", vmin=0.0)
            axes.figure.colorbar(drawn, ax=axes, label=unit, shrink=0.8)
            axes.set_axis_off()


def _dots(axes: Axes, panel: Dots) -> None:
    for name, (x, y) in panel.groups.items():
        axes.plot(x, y, ".-" if panel.joined else ".", markersize=4, linewidth=0.8, label=name)
    if panel.diagonal:
        axes.axline((0.0, 0.0), slope=1.0, color="0.6", linewidth=0.8, zorder=0)
    axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    axes.set_xlabel(panel.x, fontsize=8)
    axes.set_ylabel(panel.y, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
