"""The figures of the measurements (matplotlib without a display): SVG for documents, PNG for looking."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from sparsestreet.report.figures import front as pareto_front

Record = dict[str, Any]
"""A line of a file of records, as JSON has it."""
PlottedPoint = tuple[float, float, Record]
"""Cost, error and their record."""
# Okabe and Ito's palette: distinguishable with any color vision. One color and marker a knob.
_STYLES = {
    "default": ("#000000", "o"),
    "alpha_min": ("#0072B2", "o"),
    "max_sigma": ("#56B4E9", "s"),
    "box": ("#56B4E9", "s"),  # its name in benchmarks/knobs.jsonl
    "box alone": ("#56B4E9", "d"),
    "transmittance_min": ("#009E73", "D"),
    "stop": ("#D55E00", "v"),
    "exclusive stop": ("#D55E00", "<"),
    "eps2d": ("#999999", "h"),
    "blur": ("#999999", "h"),  # its name in benchmarks/knobs.jsonl
    "half_colors": ("#CC79A7", "P"),
    "depth_bits": ("#E69F00", "^"),
    "effects": ("#117733", ">"),
    "tile size": ("#8C564B", "p"),
    "preset": ("#000000", "*"),
    "backend": ("#7F3C8D", "X"),
}
MIN_ERROR = 1e-8
"""Least error that is drawn, so that an image equal to the truth is at the bottom, not at minus infinity."""


def draw_pareto(records: Sequence[Record], folder: Path) -> list[Path]:
    """Draw two figures with one panel per scene: image error against forward time, gradient error against whole time.

    Filled points are the default's model and form the front. Hollow points are another model (blur, clamp, effects),
    with errors against their own exact version. Presets carry their names.
    """
    measured = [record for record in records if record["kind"] == "knob" and record["exact"] is not None]
    drawn = (
        (
            "pareto_image",
            forward_time,
            image_rmse,
            "forward, ms (least of the repeats)",
            "image: RMS difference to exact",
        ),
        (
            "pareto_gradient",
            whole_time,
            gradient_l2,
            "forward + backward, ms (least of the repeats)",
            "gradient: relative L2, worst group",
        ),
    )
    paths = []
    for name, cost, error, x_label, y_label in drawn:
        paths += save_figure(_pareto_figure(measured, cost, error, x_label, y_label), folder, name)
    return paths


def forward_time(record: Record) -> float:
    """Least milliseconds of the forward pass, because other load on a machine can only add time."""
    return record["times"]["stages"]["forward"]["minimum"]


def whole_time(record: Record) -> float:
    """Least milliseconds of forward and of backward."""
    return forward_time(record) + record["times"]["stages"]["backward"]["minimum"]


def image_rmse(record: Record) -> float:
    """Root mean square difference of the image to its exact model (PSNR is -20 log10 of it)."""
    psnr = record["exact"]["image"]["psnr"]
    return MIN_ERROR if psnr is None else max(MIN_ERROR, 10 ** (-psnr / 20))


def gradient_l2(record: Record) -> float:
    """Relative L2 of the worst parameter group; infinite if a group's truth is zero and its gradient is not."""
    values = [group["relative_l2"] for group in record["exact"]["gradients"].values()]
    return math.inf if None in values else max(MIN_ERROR, *values)


def _pareto_figure(
    measured: Sequence[Record],
    cost: Callable[[Record], float],
    error: Callable[[Record], float],
    x_label: str,
    y_label: str,
) -> Figure:
    scenes = list(dict.fromkeys(record["scene"] for record in measured))
    columns = min(3, len(scenes))
    rows = len(scenes) // columns + 1  # the place after the last panel holds the legend
    figure = _blank_figure(5.4 * columns, 4.6 * rows, x_label, y_label)
    panels = {}
    for place, scene in enumerate(scenes, start=1):
        axes = figure.add_subplot(rows, columns, place)
        axes.set_title(scene, fontsize=11)
        points = [(cost(record), error(record), record) for record in measured if record["scene"] == scene]
        panels[axes] = _pareto_panel(axes, [point for point in points if math.isfinite(point[1])])
    _legend(figure.add_subplot(rows, columns, rows * columns), list(panels))
    for axes, points in panels.items():
        _label(axes, points)
    return figure


def _blank_figure(width: float, height: float, x_label: str, y_label: str) -> Figure:
    """A figure of this size in inches. Margins are fixed, because a layout engine would draw everything repeatedly."""
    figure = Figure(figsize=(width, height), dpi=110)
    left, right, bottom, top = 0.9 / width, 1 - 0.2 / width, 0.8 / height, 1 - 0.4 / height
    figure.subplots_adjust(left, bottom, right, top, wspace=0.22, hspace=0.24)
    figure.supxlabel(x_label, y=0.15 / height)
    figure.supylabel(y_label, x=0.1 / width)
    return figure


def _legend(place: Axes, panels: Sequence[Axes]) -> None:
    """Draw one legend for all panels in a place of its own."""
    handles: dict[str, Artist] = {}
    for axes in panels:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    place.axis("off")
    place.legend(handles.values(), handles.keys(), loc="center left", frameon=False, fontsize=9)


def _pareto_panel(axes: Axes, points: Sequence[PlottedPoint]) -> list[PlottedPoint]:
    """Draw a scene; return the points to be named: presets and the front."""
    own = [point for point in points if not point[2]["other_model"]]
    first = {point[:2]: point for point in reversed(own)}
    front = [first[cost, -gain] for cost, gain in pareto_front([(cost, -error) for cost, error in first])]
    x, y = [point[0] for point in front], [point[1] for point in front]
    axes.plot(x, y, color="0.6", linewidth=1.2, drawstyle="steps-post", label="Pareto front", zorder=1)
    for knob, hollow in dict.fromkeys((point[2]["knob"], point[2]["other_model"]) for point in points):
        alike = [point for point in points if (point[2]["knob"], point[2]["other_model"]) == (knob, hollow)]
        color, marker = _STYLES[knob]
        axes.scatter(
            [point[0] for point in alike],
            [point[1] for point in alike],
            s=120 if knob == "default" else 46,
            marker=marker,
            facecolors="none" if hollow else color,
            edgecolors=color,
            label=f"{knob}{' (another model)' if hollow else ''}".replace("_", " "),
            zorder=2 if knob == "default" else 3,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    for formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        formatter(FuncFormatter(_sparse))
    axes.tick_params(axis="x", which="minor", labelsize=8)
    axes.grid(alpha=0.25)
    axes.margins(x=0.16, y=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    return [point for point in points if point[2]["preset"] is not None] + _steps(front)


def _steps(front: Sequence[PlottedPoint]) -> list[PlottedPoint]:
    """Points of the front without a preset's name that lower the error by a third; more labels would hide them."""
    steps: list[PlottedPoint] = []
    least = math.inf
    for point in front:
        if point[1] < 0.67 * least:
            least = point[1]
            steps += [] if point[2]["preset"] is not None else [point]
    return steps


def _label(axes: Axes, points: Sequence[PlottedPoint]) -> None:
    """Write names next to points. If names would overlap, the later one moves up or down to the next free place."""
    _ = axes.get_xlim(), axes.get_ylim()  # fixes the limits, and with them the transform to pixels
    bottom, top, end_of_panel = (float(side) for side in (axes.bbox.y0, axes.bbox.y1, axes.bbox.x1))
    pixel = 72 / axes.figure.dpi
    height = 9.5 / pixel
    taken: list[tuple[float, float, float]] = []
    for time, value, record in sorted(points, key=lambda point: (point[2]["preset"] is None, point[1])):
        preset = record["preset"]
        text = preset if preset is not None else f"{record['knob']} {record['value']}".replace("_", " ")
        x, y = axes.transData.transform((time, value)).tolist()
        width = 4.9 * len(text) / pixel
        left = x + 7 / pixel if x + 7 / pixel + width < end_of_panel else x - 7 / pixel - width

        def free(shift: float, left: float = left, width: float = width, y: float = y) -> bool:
            return bottom + height / 2 < y + shift < top - height / 2 and all(
                left + width < start or left > end or abs(y + shift - middle) >= height for start, end, middle in taken
            )

        shift = next((step * height for step in sorted(range(-30, 31), key=abs) if free(step * height)), 0.0)
        taken.append((left, left + width, y + shift))
        axes.annotate(
            text,
            (time, value),
            xytext=((left - x) * pixel, shift * pixel),
            textcoords="offset points",
            fontsize=8,
            fontweight="bold" if preset is not None else "normal",
            va="center",
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.6} if shift else None,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.4},
            zorder=4,
        )


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    vector, pixels = folder / f"{name}.svg", folder / f"{name}.png"
    # Text stays text, which takes an eighth of the size. Without a date, a redrawn figure is the same file.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "sparsestreet"}):
        figure.savefig(vector, metadata={"Date": None})
    figure.savefig(pixels)
    return [vector, pixels]


def _sparse(value: float, _: int) -> str:
    """Labels only 1, 2 and 5 of each decade, because nine labels would overlap."""
    digit = round(value / 10 ** math.floor(math.log10(value)))
    return f"{value:g}" if digit in (1, 2, 5) else ""
