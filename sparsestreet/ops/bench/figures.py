"""The figures of the measurements (matplotlib without a display): SVG for documents, PNG for looking."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from sparsestreet.ops.bench.fit import Line
from sparsestreet.ops.bench.pareto import pareto_front
from sparsestreet.ops.bench.records import Json

Record = dict[str, Json]
# Okabe and Ito's palette: distinguishable with any colour vision. One colour and marker a knob.
_STYLES = {
    "default": ("#000000", "o"),
    "alpha_min": ("#0072B2", "o"),
    "box": ("#56B4E9", "s"),
    "transmittance_min": ("#009E73", "D"),
    "stop": ("#D55E00", "v"),
    "blur": ("#999999", "h"),
    "half_colors": ("#CC79A7", "P"),
    "depth_bits": ("#E69F00", "^"),
    "preset": ("#000000", "*"),
    "backend": ("#7F3C8D", "X"),
}
LEAST_ERROR = 1e-8
"""Errors are drawn no lower: an image equal to the truth has its place at the bottom, not at minus infinity."""


def draw_pareto(records: Sequence[Record], folder: Path) -> list[Path]:
    """Two figures of a panel a scene: image error against forward time, gradient error against the whole time.

    Filled points are the default's model and make up the front; hollow ones are another model (blur, clamp), whose
    error is against their own exact version. Presets carry their names.
    """
    measured = [record for record in records if record["kind"] == "knob" and record["skipped"] is None]
    drawn = (
        ("pareto_image", forward_time, image_rmse, "forward, ms", "image: RMS difference to exact"),
        ("pareto_gradient", whole_time, gradient_l2, "forward + backward, ms", "gradient: relative L2, worst group"),
    )
    paths = []
    for name, cost, error, x_label, y_label in drawn:
        figure = _pareto_figure(measured, cost, error)
        figure.supxlabel(x_label)
        figure.supylabel(y_label)
        paths += _save(figure, folder, name)
    return paths


def forward_time(record: Record) -> float:
    """Median milliseconds of the forward pass."""
    return record["times"]["stages"]["forward"]["median"]


def whole_time(record: Record) -> float:
    """Median milliseconds of forward and backward."""
    return forward_time(record) + record["times"]["stages"]["backward"]["median"]


def image_rmse(record: Record) -> float:
    """Root mean square difference of the image to its exact model (PSNR is -20 log10 of it)."""
    psnr = record["exact"]["image"]["psnr"]
    return LEAST_ERROR if psnr is None else max(LEAST_ERROR, 10 ** (-psnr / 20))


def gradient_l2(record: Record) -> float:
    """Relative L2 of the worst parameter group; infinite where one has a zero truth and no zero answer."""
    values = [group["relative_l2"] for group in record["exact"]["gradients"].values()]
    return math.inf if None in values else max(LEAST_ERROR, *values)


def _pareto_figure(
    measured: Sequence[Record], cost: Callable[[Record], float], error: Callable[[Record], float]
) -> Figure:
    scenes = list(dict.fromkeys(record["scene"] for record in measured))
    columns = min(3, len(scenes))
    rows = -(-(len(scenes) + (len(scenes) % columns != 0)) // columns) if columns > 1 else len(scenes)
    figure = Figure(figsize=(5.0 * columns, 4.2 * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = [figure.add_subplot(rows, columns, place + 1) for place in range(len(scenes))]
    for axes, scene in zip(grid, scenes, strict=True):
        _pareto_panel(axes, [record for record in measured if record["scene"] == scene], cost, error)
        axes.set_title(scene, fontsize=11)
    handles = {}
    for axes in grid:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    spare = rows * columns > len(scenes)
    place = figure.add_subplot(rows, columns, rows * columns) if spare else grid[-1]
    if spare:
        place.axis("off")
    place.legend(handles.values(), handles.keys(), loc="center left" if spare else "best", frameon=False, fontsize=9)
    return figure


def _pareto_panel(
    axes: Axes, records: Sequence[Record], cost: Callable[[Record], float], error: Callable[[Record], float]
) -> None:
    points = [(cost(record), error(record), record) for record in records if math.isfinite(error(record))]
    own = [point for point in points if not point[2]["other_model"]]
    front = [own[index] for index in pareto_front([point[:2] for point in own])]
    axes.plot(
        [point[0] for point in front],
        [point[1] for point in front],
        color="0.6",
        linewidth=1.2,
        drawstyle="steps-post",
        label="Pareto front",
        zorder=1,
    )
    for time, value, record in points:
        color, marker = _STYLES[record["knob"]]
        hollow = record["other_model"]
        axes.scatter(
            time,
            value,
            s=110 if record["preset"] == "default" else 46,
            marker=marker,
            facecolors="none" if hollow else color,
            edgecolors=color,
            label=f"{record['knob']}{' (another model)' if hollow else ''}".replace("_", " "),
            zorder=2,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))
    axes.xaxis.set_minor_formatter(FuncFormatter(_sparse))
    axes.tick_params(axis="x", which="minor", labelsize=8)
    axes.grid(alpha=0.25)
    axes.margins(x=0.16, y=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    _label(axes, [point for point in points if point[2]["preset"] is not None or point in front])


def _label(axes: Axes, points: Sequence[tuple[float, float, Record]]) -> None:
    """Names beside points; of names that would overlap, the later one moves up or down to the next free place."""
    axes.figure.draw_without_rendering()
    taken: list[tuple[float, float, float, float]] = []
    for time, value, record in sorted(points, key=lambda point: (point[2]["preset"] is None, point[1])):
        preset = record["preset"]
        text = preset if preset is not None else f"{record['knob']} {record['value']}".replace("_", " ")
        x, y = axes.transData.transform((time, value))
        width, height = 5.6 * len(text) * axes.figure.dpi / 100, 11.0 * axes.figure.dpi / 100
        right = x + 10 + width < axes.bbox.x1
        left = x + 8 if right else x - 8 - width
        shift = next(
            step * height
            for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6, 7, -7, 8, -8, 9, -9, 99)
            if all(left + width < box[0] or left > box[1] or abs(y + step * height - box[2]) >= height for box in taken)
        )
        taken.append((left, left + width, y + shift, height))
        pixels = 72 / axes.figure.dpi
        axes.annotate(
            text,
            (time, value),
            xytext=((left - x) * pixels, shift * pixels),
            textcoords="offset points",
            fontsize=8,
            fontweight="bold" if preset is not None else "normal",
            va="center",
            arrowprops={"arrowstyle": "-", "color": "0.75", "linewidth": 0.6} if shift else None,
        )


def draw_scaling(
    work: Sequence[float], times: dict[str, Sequence[float]], lines: dict[str, Line], folder: Path
) -> list[Path]:
    """Milliseconds of each part against (splat, tile) pairs, with its straight line; both axes logarithmic."""
    figure = Figure(figsize=(7.2, 4.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    dense = [min(work) * (max(work) / min(work)) ** (step / 60) for step in range(61)]
    for (name, values), color in zip(times.items(), ("#0072B2", "#D55E00", "#009E73"), strict=False):
        line = lines[name]
        label = f"{name}: {line.intercept:.3g} ms + {1e6 * line.slope:.3g} ns a pair, R² = {line.r_squared:.4f}"
        axes.plot(dense, [line.at(pairs) for pairs in dense], color=color, linewidth=1.2, label=label)
        axes.scatter(work, values, color=color, s=30, zorder=3)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("(splat, tile) pairs")
    axes.set_ylabel("median time, ms")
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return _save(figure, folder, "scaling")


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    for path in paths:
        figure.savefig(path)
    return paths


def _plain(value: float, _: int) -> str:
    return f"{value:g}"


def _sparse(value: float, _: int) -> str:
    """Only 2 and 5 of each decade: all nine would run into each other."""
    digit = round(value / 10 ** math.floor(math.log10(value)))
    return f"{value:g}" if digit in (2, 5) else ""
