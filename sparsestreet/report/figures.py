"""Figures of a sweep: their style, and quality against each cost (matplotlib without a display)."""

import io
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sparsestreet.metrics.protocols import Protocol
from sparsestreet.records.quality import HELD_OUT
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.arms import Arm, Unit, Value, by_scene, plain_of

# Okabe and Ito's palette with a slightly lighter blue: distinguishable with any color vision, on white and on black.
COLORS = ("#1f86c9", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#8c8c8c"
_MARKERS = {"none": "o", "paper": "s", "paper_short": "s", "removal": "D", "masks": "^", "importance": "v"}
_MARKERS |= {"random": "x", "opacity": "+"}
_INK = "#010203"
"""Stands for the color of the page's text."""

_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _INK),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.color": GREY,
}

LEGEND = {"frameon": False, "labelcolor": _INK, "fontsize": 8}
"""Style of every legend."""

PARETO_COSTS: tuple[tuple[str, str, Callable[[RunSummary], float | None]], ...] = (
    ("gaussians", "Gaussians", lambda run: float(run.gaussians_total)),
    ("megabytes", "MB", lambda run: run.bytes_total / 1e6),
    ("frame", "milliseconds a frame", lambda run: run.latency.p50),
    ("training", "training minutes", lambda run: run.run.training_seconds and run.run.training_seconds / 60),
)
"""Name, axis label and value of each cost that quality is drawn against."""


def panels(columns: int, width: float = 3.2, height: float = 3.4) -> tuple[Figure, list[Axes]]:
    """Returns a figure with panels in one row."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width * columns, height), layout="constrained")
        figure.patch.set_alpha(0)
        axes = list(figure.subplots(1, columns, squeeze=False)[0])
    for one in axes:
        one.patch.set_alpha(0)
    return figure, axes


Says = dict[str, list[str]]
"""Name of a group of marks in a figure -> what each of them says when somebody points at it."""


def write_svg(figure: Figure, path: Path, says: Says | None = None) -> None:
    """Writes the figure as SVG in the page's own text color; the same numbers give the same bytes.

    Artists whose ``gid`` is a key of ``says`` have marks that say something: a ``<title>`` each, in their order.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": path.stem}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None, "Title": path.stem})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(_INK, "currentColor")
    for name, texts in (says or {}).items():
        text = _titled(text, name, texts)
    # Several figures of one page would share these names of groups. References use definitions, named by content.
    text = re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", text)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _titled(svg: str, name: str, texts: Sequence[str]) -> str:
    """Returns the figure with a title in each mark of a group. Raises ValueError where it has fewer marks."""
    head, group, tail = svg.partition(f'<g id="{name}">')
    tail, behind, rest_of_figure = tail.partition('<g id="')
    rest = iter(texts)

    def titled(mark: re.Match[str]) -> str:
        return f"{mark[1]}><title>{escape(next(rest))}</title></{mark[2]}>"

    # A single hollow mark is drawn as it is, all others from a definition.
    kind = "use" if "<use " in tail else "path"
    tail, found = re.subn(rf"(<({kind}) [^>]*?)/>", titled, tail, count=len(texts))
    if not group or found < len(texts):
        raise ValueError(f"the figure has {found} marks in {name!r}, and {len(texts)} texts")
    return f"{head}<g>{tail}{behind}{rest_of_figure}"


def colors(arms: Sequence[Arm]) -> dict[str, str]:
    """Returns label of a plain method -> its color."""
    labels = list(dict.fromkeys(arm.plain_label for arm in arms))
    return {label: COLORS[index % len(COLORS)] for index, label in enumerate(labels)}


def of_sparsify(arm: Arm) -> str:
    """Returns the color of an arm's sparsification, for figures of one method."""
    known = {"none": 0, "paper": 1, "paper_short": 1, "removal": 2, "masks": 3, "importance": 4}
    return COLORS[known.get(arm.sparsify, 5)]


def short(value: float) -> str:
    """Returns a number in short form.

    >>> short(12e3), short(1.5e6), short(950.0)
    ('12k', '1.5M', '950')
    """
    unit, size = next(((unit, size) for unit, size in (("M", 1e6), ("k", 1e3)) if value >= size), ("", 1.0))
    return f"{value / size:g}{unit}"


def marker(arm: Arm) -> str:
    """Returns the marker of an arm's sparsification."""
    return _MARKERS.get(arm.sparsify, "P")


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns the Pareto front of (cost, quality) points, sorted by cost.

    >>> front([(1.0, 20.0), (2.0, 25.0), (3.0, 24.0)])
    [(1.0, 20.0), (2.0, 25.0)]
    """
    best: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], -point[1])):
        if not best or quality > best[-1][1]:
            best.append((cost, quality))
    return best


def pareto(arms: Sequence[Arm], protocol: Protocol, cost: tuple[str, str, Value], path: Path) -> bool:
    """Draws quality of the full image, people and vehicles against one cost. Returns whether there was any to draw.

    Every run is a small mark, every arm's mean a large one, with an arrow from plain to pruned. The front is that of
    the means; controls are gray and in no front.
    """
    wanted = {"full image": protocol.psnr, "people": protocol.human[0], "vehicles": protocol.vehicle[0]}
    regions = {name: _held_out(metric) for name, metric in wanted.items()}
    regions = {name: value for name, value in regions.items() if any(arm.mean(value) is not None for arm in arms)}
    if not regions or all(arm.mean(cost[2]) is None for arm in arms):
        return False
    figure, axes = panels(len(regions))
    says: Says = {}
    for index, (one, (name, value)) in enumerate(zip(axes, regions.items(), strict=True)):
        says |= _pareto_panel(one, arms, cost, value, name)
        one.set_title(name, fontsize=10)
        one.set_xlabel(cost[1])
        if index == 0:
            one.set_ylabel("held-out PSNR, dB")
    figure.legend(handles=_legend(arms), loc="outside lower center", ncols=4, **LEGEND)
    write_svg(figure, path, says)
    return True


def _held_out(metric: str) -> Value:
    return lambda run: run.mean(metric, HELD_OUT)


def _pareto_panel(axes: Axes, arms: Sequence[Arm], of: tuple[str, str, Value], quality: Value, region: str) -> Says:
    color = colors(arms)
    cost, unit = of[2], of[1]
    means: dict[str, tuple[float, float]] = {}
    says: Says = {}
    for number, arm in enumerate(arms):
        paint = GREY if arm.control else color[arm.plain_label]
        points = _points(arm, cost, quality)
        if not points:
            continue
        axes.scatter(*zip(*points.values(), strict=True), s=9, alpha=0.45, color=paint, marker=marker(arm),
                     linewidths=0.8, gid=(runs := f"{region} {number} runs"))  # fmt: skip
        means[arm.name] = _mean_point(points)
        says[runs] = [f"{arm.name}, {scene}, seed {seed}: {_in_words(point, unit)}"
                      for ((scene, _), seed), point in points.items()]  # fmt: skip
        says[f"{region} {number} mean"] = [f"{arm.title}, mean: {_in_words(means[arm.name], unit)}"]
        # A marker of lines has no inside to leave empty: it is drawn thin.
        hollow = {"facecolors": "none", "edgecolors": paint} if marker(arm) not in "x+" else {"color": paint}
        shape = {**hollow, "linewidths": 0.8} if arm.lacks else {"color": paint, "linewidths": 1.6}
        axes.scatter(*means[arm.name], s=48, marker=marker(arm), zorder=3, gid=f"{region} {number} mean", **shape)
    for arm in arms:
        ends = None if arm.control else paired_means(arm, plain_of(arm, arms), cost, quality)
        if ends is not None:
            arrow = {"arrowstyle": "->", "color": color[arm.plain_label], "alpha": 0.7, "shrinkA": 5, "shrinkB": 5}
            axes.annotate("", ends[1], ends[0], arrowprops=arrow)
    best = front([means[arm.name] for arm in arms if arm.name in means and not arm.control and not arm.lacks])
    if best:
        axes.plot(*zip(*best, strict=True), color=_INK, linewidth=0.9, linestyle="--", zorder=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if high > 10 * low else MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    return says


def _in_words(point: tuple[float, float], unit: str) -> str:
    cost = f"{point[0]:,.0f}" if point[0] >= 1000 else f"{point[0]:.4g}"
    return f"{point[1]:.3f} dB, {cost} {unit}"


def paired_means(
    arm: Arm, plain: Arm | None, cost: Value, quality: Value
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Returns where an arrow starts and ends: the means of the plain arm and of an arm over the units of both.

    None for the plain arm itself, without one, and without a common unit.
    """
    if plain is None or plain is arm:
        return None
    ours, theirs = _points(arm, cost, quality), _points(plain, cost, quality)
    shared = ours.keys() & theirs.keys()
    if not shared:
        return None
    start, end = (_mean_point({unit: points[unit] for unit in shared}) for points in (theirs, ours))
    return start, end


def _points(arm: Arm, cost: Value, quality: Value) -> dict[Unit, tuple[float, float]]:
    """Returns scene and seed -> cost and quality, where both are known."""
    costs, qualities = arm.units(cost), arm.units(quality)
    return {unit: (costs[unit], qualities[unit]) for unit in sorted(costs.keys() & qualities.keys())}


def _mean_point(points: Mapping[Unit, tuple[float, float]]) -> tuple[float, float]:
    """Returns the mean over scenes of the mean over each scene's seeds."""
    scenes = (by_scene({unit: point[axis] for unit, point in points.items()}) for axis in (0, 1))
    x, y = (statistics.fmean(means.values()) for means in scenes)
    return x, y


def _legend(arms: Sequence[Arm]) -> list[Line2D]:
    dots = [Line2D([], [], color=paint, marker="o", linestyle="", label=name) for name, paint in colors(arms).items()]
    kinds = {arm.sparsify: arm for arm in arms}
    shapes = [
        Line2D(
            [],
            [],
            color=GREY if arm.control else _INK,
            marker=marker(arm),
            linestyle="",
            markerfacecolor="none",
            label=f"control: {name}" if arm.control else {"none": "plain"}.get(name, name),
        )
        for name, arm in kinds.items()
    ]
    return [*dots, *shapes, Line2D([], [], color=_INK, linestyle="--", linewidth=0.9, label="front of the means")]
