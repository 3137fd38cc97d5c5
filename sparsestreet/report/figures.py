"""Figures of a sweep (matplotlib without a display): quality against costs, curves over time, a frame's parts."""

import io
import re
import statistics
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import matplotlib
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.pictures.plots import count_curves, marks
from sparsestreet.records.costs import COSTS
from sparsestreet.records.curves import LEDGER
from sparsestreet.records.summary import HELD_OUT
from sparsestreet.report.collect import by_scene
from sparsestreet.report.costs import curves_of, curves_of_runs, mean_curve, timed_busy
from sparsestreet.report.tables import BUSY
from sparsestreet.report.variants import Variant, plain_of

T = TypeVar("T")

# Okabe and Ito's palette with a slightly lighter blue: distinguishable with any color vision, on white and on black.
# The last four are for the seventh variant and on.
COLORS = ("#1f86c9", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7a5195", "#8c564b", "#5c6f1c", "#b3003c")
GREY = "#8c8c8c"
_MARKERS = {"none": "o", "paper": "s", "paper_short": "s", "removal": "D", "masks": "^", "importance": "v"}
_MARKERS |= {"random": "x", "opacity": "+"}
_SPARE = "P^vX*<>phd8H"
"""Markers of other variants, in turn."""
_DASHES = ("-", "--", ":", "-.")
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

PARETO_COSTS = (
    ("gaussians", "Gaussians", "Gaussians"),
    ("megabytes", "MB", "MB"),
    ("frame", "milliseconds a frame", "ms/frame"),
    ("training", "training minutes", "train minutes"),
)
"""Name, axis label and column of each cost that quality is drawn against."""
_CLOCK_OF = {"ms/frame": "frames", "train minutes": "training"}
"""Column of times -> what its machine was measured with."""


def _axis_of_times(label: str, busy: bool) -> str:
    """Return the label of an axis with the mark of times, if any that it shows is of a machine that was not quiet."""
    return f"{label} {BUSY}" if busy else label


def panels(columns: int, width: float = 3.2, height: float = 3.4) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels in one row."""
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
    """Write the figure as SVG in the page's own text color; the same numbers give the same bytes.

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
    """Return the figure with a title in each mark of a group. Raises ValueError where it has fewer marks."""
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


@dataclass(frozen=True)
class Style:
    """How a variant is drawn. Two variants of a figure differ in it."""

    kind: str
    """What the variant is beside its method: its sparsification, or all that its name says where that is of several."""
    method: str
    """Color of the variant's method; grey for a control."""
    color: str
    """Color of its kind, for figures or panels of one method; grey for a control."""
    marker: str
    dashes: str


def styles(variants: Sequence[Variant]) -> dict[str, Style]:
    """Return name of a variant -> how it is drawn, with one color a method, and one color, marker and dash a kind."""
    methods, kinds = list(dict.fromkeys(variant.plain_label for variant in variants)), _kinds(variants)
    every = list(dict.fromkeys(kinds.values()))
    known = {"none": 0, "paper": 1, "paper_short": 1, "removal": 2, "masks": 3, "importance": 4}
    colored = _in_turn(every, known, range(len(COLORS)))
    marked = _in_turn(every, _MARKERS, _SPARE)
    found = {}
    for variant in variants:
        kind = kinds[variant.name]
        own = {"capped": ":", "random": "--", "opacity": "-."}.get(kind)
        dashes = own or _DASHES[every.index(kind) // len(COLORS) % len(_DASHES)]
        if variant.control and not own:
            dashes = _DASHES[every.index(kind) % len(_DASHES)]
        method = COLORS[methods.index(variant.plain_label) % len(COLORS)]
        paints = (GREY, GREY) if variant.control else (method, COLORS[colored[kind]])
        found[variant.name] = Style(_in_legend(variant, kind), *paints, marked[kind], dashes)
    return found


def _kinds(variants: Sequence[Variant]) -> dict[str, str]:
    """Return name of a variant -> its sparsification, or all that its name says beside its method."""
    of_method = Counter((variant.plain_label, variant.sparsify) for variant in variants)
    several = {sparsify for (_, sparsify), number in of_method.items() if number > 1}
    return {
        variant.name: (variant.name.removeprefix(variant.plain_label).strip(" +") or variant.sparsify)
        if variant.sparsify in several
        else variant.sparsify
        for variant in variants
    }


def _in_turn(kinds: Sequence[str], known: Mapping[str, T], spare: Sequence[T]) -> dict[str, T]:
    """Return kind -> the value that it is known by, or the next that no other has; in turn where all are taken."""
    found: dict[str, T] = {}
    for kind in kinds:
        if kind in known and known[kind] not in found.values():
            found[kind] = known[kind]
    left = [one for one in spare if one not in found.values()] or list(spare)
    others = [kind for kind in kinds if kind not in found]
    return found | {kind: left[index % len(left)] for index, kind in enumerate(others)}


def _in_legend(variant: Variant, kind: str) -> str:
    if variant.control:
        return f"control: {kind}"
    return "plain" if kind == "none" else f"plain {kind}" if variant.sparsify == "none" else kind


def short(value: float) -> str:
    """Return a number in short form.

    >>> short(12e3), short(1.5e6), short(950.0)
    ('12k', '1.5M', '950')
    """
    unit, size = next(((unit, size) for unit, size in (("M", 1e6), ("k", 1e3)) if value >= size), ("", 1.0))
    return f"{value / size:g}{unit}"


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the Pareto front of (cost, quality) points, sorted by cost.

    >>> front([(1.0, 20.0), (2.0, 25.0), (3.0, 24.0)])
    [(1.0, 20.0), (2.0, 25.0)]
    """
    best: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], -point[1])):
        if not best or quality > best[-1][1]:
            best.append((cost, quality))
    return best


def pareto(variants: Sequence[Variant], protocol: Protocol, cost: tuple[str, str, str], path: Path) -> bool:
    """Draw quality of the full image, people and vehicles against one cost. Returns whether there was any to draw.

    Every run is a small mark, every variant's mean a large one, with an arrow from plain to pruned. The front is that
    of the means; controls are gray and in no front.
    """
    wanted = {"full image": protocol.psnr, "people": protocol.human[0], "vehicles": protocol.vehicle[0]}
    regions = {name: f"{HELD_OUT} {metric}" for name, metric in wanted.items()}
    regions = {
        name: value for name, value in regions.items() if any(variant.mean(value) is not None for variant in variants)
    }
    if not regions or all(variant.mean(cost[2]) is None for variant in variants):
        return False
    figure, axes = panels(len(regions))
    says: Says = {}
    for index, (one, (name, value)) in enumerate(zip(axes, regions.items(), strict=True)):
        says |= _pareto_panel(one, variants, cost, value, name)
        one.set_title(name, fontsize=10)
        clock = _CLOCK_OF.get(cost[2])
        one.set_xlabel(_axis_of_times(cost[1], any(variant.busy(clock) for variant in variants if clock)))
        if index == 0:
            one.set_ylabel("held-out PSNR, dB")
    legend_below(figure, _legend(variants))
    write_svg(figure, path, says)
    return True


def _pareto_panel(axes: Axes, variants: Sequence[Variant], of: tuple[str, str, str], quality: str, region: str) -> Says:
    style = styles(variants)
    cost, unit = of[2], of[1]
    means: dict[str, tuple[float, float]] = {}
    says: Says = {}
    for number, variant in enumerate(variants):
        paint, marker = _paint(style, variant), style[variant.name].marker
        points = _points(variant, cost, quality)
        if points.empty:
            continue
        axes.scatter(points["cost"], points["quality"], s=9, alpha=0.45, color=paint, marker=marker,
                     linewidths=0.8, gid=(runs := f"{region} {number} runs"))  # fmt: skip
        means[variant.name] = _mean_point(points)
        says[runs] = [f"{variant.name}, {scene}, seed {seed}: {_in_words(point, unit)}"
                      for (scene, _, seed), *point in points.itertuples()]  # fmt: skip
        says[f"{region} {number} mean"] = [f"{variant.title}, mean: {_in_words(means[variant.name], unit)}"]
        # A marker of lines has no inside to leave empty: it is drawn thin.
        hollow = {"facecolors": "none", "edgecolors": paint} if marker not in "x+" else {"color": paint}
        shape = {**hollow, "linewidths": 0.8} if variant.lacks else {"color": paint, "linewidths": 1.6}
        axes.scatter(*means[variant.name], s=48, marker=marker, zorder=3, gid=f"{region} {number} mean", **shape)
    for variant in variants:
        ends = None if variant.control else paired_means(variant, plain_of(variant, variants), cost, quality)
        if ends is not None:
            arrow = {"arrowstyle": "->", "color": _paint(style, variant), "alpha": 0.7, "shrinkA": 5, "shrinkB": 5}
            axes.annotate("", ends[1], ends[0], arrowprops=arrow)
    best = front(
        [
            means[variant.name]
            for variant in variants
            if variant.name in means and not variant.control and not variant.lacks
        ]
    )
    if best:
        axes.plot(*zip(*best, strict=True), color=_INK, linewidth=0.9, linestyle="--", zorder=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if high > 10 * low else MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    return says


def _paint(style: Mapping[str, Style], variant: Variant) -> str:
    """Return the color of the method, or of the kind if there is one method."""
    own = style[variant.name]
    return own.color if len({one.method for one in style.values()} - {GREY}) <= 1 else own.method


def legend_below(figure: Figure, handles: Sequence[Artist]) -> None:
    """Add a legend below the panels, in as many columns as its longest name lets fit; its further rows add height."""
    longest = max(len(str(handle.get_label())) for handle in handles)
    columns = max(1, min(4, int(figure.get_figwidth() / (0.4 + 0.065 * longest))))
    rows = -(-len(handles) // columns)
    figure.set_figheight(figure.get_figheight() + 0.17 * max(rows - 2, 0))
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, **LEGEND)


def _in_words(point: Sequence[float], unit: str) -> str:
    cost = f"{point[0]:,.0f}" if point[0] >= 1000 else f"{point[0]:.4g}"
    return f"{point[1]:.3f} dB, {cost} {unit}"


def paired_means(
    variant: Variant, plain: Variant | None, cost: str, quality: str
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return where an arrow starts and ends: the means of the plain variant and of a variant over the units of both.

    None for the plain variant itself, without one, and without a common unit.
    """
    if plain is None or plain is variant:
        return None
    ours, theirs = _points(variant, cost, quality), _points(plain, cost, quality)
    shared = ours.index.intersection(theirs.index)
    return None if shared.empty else (_mean_point(theirs.loc[shared]), _mean_point(ours.loc[shared]))


def _points(variant: Variant, cost: str, quality: str) -> pd.DataFrame:
    """Return scene, clip and seed -> cost and quality, where both are known."""
    both = {"cost": variant.units(cost), "quality": variant.units(quality)}
    return pd.concat(both, axis=1, join="inner").sort_index()


def _mean_point(points: pd.DataFrame) -> tuple[float, float]:
    """Return the mean over scenes of the mean over each scene's seeds."""
    x, y = (statistics.fmean(by_scene(pd.Series(points[axis]))) for axis in ("cost", "quality"))
    return x, y


def _legend(variants: Sequence[Variant]) -> list[Line2D]:
    style = styles(variants)
    methods = {variant.plain_label: style[variant.name].method for variant in variants if not variant.control}
    dots = [Line2D([], [], color=paint, marker="o", linestyle="", label=name) for name, paint in methods.items()]
    # Of one method, the color is the kind's.
    dots, alone = (dots, False) if len(methods) > 1 else ([], True)
    kinds = {style[variant.name].kind: variant for variant in variants}
    shapes = [
        Line2D(
            [],
            [],
            color=GREY if variant.control else style[variant.name].color if alone else _INK,
            marker=style[variant.name].marker,
            linestyle="",
            markerfacecolor="none",
            label=kind,
        )
        for kind, variant in kinds.items()
    ]
    return [*dots, *shapes, Line2D([], [], color=_INK, linestyle="--", linewidth=0.9, label="front of the means")]


_MAX_NAMES_IN_PANEL = 6
"""Largest number of names in a legend that stands within a panel."""


def held_out_over_time(variants: Sequence[Variant], path: Path) -> bool:
    """Draw held-out PSNR over training seconds, a panel a method, a line a run. Return whether a run has a curve."""
    found = {
        variant.name: [curve for some in curves_of_runs(variant).values() for curve in some] for variant in variants
    }
    drawn = [variant for variant in variants if found[variant.name]]
    says: Says = {}

    def draw(axes: Axes, variant: Variant, look: Style) -> None:
        for curve in found[variant.name]:
            name = f"curve {len(says)}"
            axes.plot(curve.seconds, curve.psnr, **_line(look), marker=".", markersize=3, gid=name)
            looks = zip(curve.seconds, curve.psnr, strict=True)
            says[name] = [f"{variant.name}: {psnr:.3f} dB after {at:.1f} s" for at, psnr in looks]

    seconds = _axis_of_times("training seconds", any(variant.busy("training") for variant in drawn))
    return _over_time(variants, drawn, draw, (seconds, "held-out PSNR, dB"), path, says)


def counts_over_time(variants: Sequence[Variant], path: Path) -> bool:
    """Draw the number of Gaussians over steps, a panel a method, a line a run; dots mark masks and pruning passes."""
    drawn = [variant for variant in variants if any(LEDGER.exists(record.folder) for record in variant.records)]

    def draw(axes: Axes, variant: Variant, look: Style) -> None:
        for record in variant.records:
            if LEDGER.exists(record.folder):
                _counts(axes, look, record.folder)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))

    return _over_time(variants, drawn, draw, ("step", "Gaussians"), path, {})


def _over_time(
    variants: Sequence[Variant],
    drawn: Sequence[Variant],
    draw: Callable[[Axes, Variant, Style], None],
    labels: tuple[str, str],
    path: Path,
    says: Says,
) -> bool:
    """Write a panel for each method of the drawn variants. Return whether there is any."""
    methods = list(dict.fromkeys(variant.plain_label for variant in drawn))
    if not methods:
        return False
    figure, axes = panels(len(methods))
    look = styles(variants)
    for one, method in zip(axes, methods, strict=True):
        for variant in drawn:
            if variant.plain_label == method:
                draw(one, variant, look[variant.name])
        one.set_title(method, fontsize=10)
        one.set_xlabel(labels[0])
    axes[0].set_ylabel(labels[1])
    _legends(figure, axes)
    write_svg(figure, path, says)
    return True


def _counts(axes: Axes, look: Style, folder: Path) -> None:
    changes = LEDGER.read(folder)
    steps, nodes = count_curves(changes)
    total = [sum(values) for values in zip(*nodes.values(), strict=True)]
    axes.plot(steps, total, drawstyle="steps-post", **_line(look))
    at = dict(zip(steps, total, strict=True))
    taken = sorted({step for step, _ in marks(changes)})
    axes.plot(taken, [at[step] for step in taken], ".", markersize=4, color=look.color, label="_")


def frame_waterfall(variants: Sequence[Variant], path: Path) -> bool:
    """Draw the additional time of a frame with each node and effect, a bar a variant. Returns whether a run has it."""
    costs = {variant.name: _frame_costs(variant) for variant in variants}
    drawn = [variant for variant in variants if costs[variant.name]]
    if not drawn:
        return False
    parts = list(dict.fromkeys(part for variant in drawn for part in costs[variant.name]))
    titles = [textwrap.wrap(variant.title, 40) for variant in drawn]
    # A bar is as high as the most lines of a name, which would run into its neighbors'.
    figure, (axes,) = panels(1, width=7.4, height=1.1 + max(0.34, 0.16 * max(map(len, titles)) + 0.08) * len(drawn))
    for row, variant in enumerate(drawn):
        left = 0.0
        for part, ms in costs[variant.name].items():
            index = parts.index(part)
            hatch = "//" if part.startswith("effect") else None
            axes.barh(row, ms, left=left, height=0.62, color=COLORS[index % len(COLORS)], hatch=hatch,
                      edgecolor="white", linewidth=0.4, label="_")  # fmt: skip
            left += ms
    for index, part in enumerate(parts):
        hatch = "//" if part.startswith("effect") else None
        axes.barh([0], [0], color=COLORS[index % len(COLORS)], hatch=hatch, edgecolor="white", label=part)
    axes.set_yticks(range(len(drawn)), ["\n".join(lines) for lines in titles])
    axes.invert_yaxis()
    axes.axvline(0, color=GREY, linewidth=0.8)
    records = [COSTS.find(record.folder) for variant in drawn for record in variant.records]
    axes.set_xlabel(_axis_of_times("milliseconds that a frame takes longer with it", timed_busy(records)))
    figure.legend(loc="outside lower center", ncols=5, **LEGEND)
    write_svg(figure, path)
    return True


def _frame_costs(variant: Variant) -> dict[str, float]:
    """Return node or effect -> mean milliseconds over the runs that recorded it."""
    found: dict[str, list[float]] = {}
    for costs in filter(None, (COSTS.find(record.folder) for record in variant.records)):
        parts = {name: node.ms for name, node in costs.nodes.items()}
        for part, ms in (parts | {f"effect: {name}": ms for name, ms in costs.effects.items()}).items():
            found.setdefault(part, []).append(ms)
    return {part: statistics.fmean(values) for part, values in found.items()}


def _line(look: Style) -> dict[str, Any]:
    return {"color": look.color, "linestyle": look.dashes, "linewidth": 1.2, "alpha": 0.85, "label": look.kind}


def _legends(figure: Figure, axes: Sequence[Axes]) -> None:
    """Add a legend to each panel, or one below all of them if it would hide the curves."""
    named = [dict(zip(*reversed(one.get_legend_handles_labels()), strict=True)) for one in axes]
    if max(map(len, named)) <= _MAX_NAMES_IN_PANEL:
        for one, once in zip(axes, named, strict=True):
            one.legend(once.values(), once.keys(), **LEGEND)
        return
    once = {name: handle for some in named for name, handle in some.items()}
    legend_below(figure, list(once.values()))


_DASHES_OF_KIND = {"plain": "-", "paper": "--", "paper_short": "--", "removal": ":"}


def time_figure(variants: Sequence[Variant], protocol: Protocol, path: Path) -> None:
    """Write a PNG: held-out PSNR over training seconds and over milliseconds a frame, without controls.

    Curves are means over scenes and seeds at each look. Without curves, only the end of training is drawn. Raises
    ValueError if no run has a held-out PSNR.
    """
    quality = f"{HELD_OUT} {protocol.psnr}"
    shown = [variant for variant in variants if not variant.control and variant.mean(quality) is not None]
    if not shown:
        raise ValueError("no run was evaluated on held-out views, which the figure shows: train with split.stride > 0")
    figure, (training, frame) = panels(2, width=4.6, height=4.0)
    for variant in shown:
        _over_training(training, variant, shown, quality)
        _draw_points(frame, variant, shown, "ms/frame", quality)
    training.set_xlabel("training seconds")
    frame.set_xlabel("milliseconds a frame")
    training.set_ylabel("held-out PSNR, dB")
    legend_below(figure, training.get_legend_handles_labels()[0])
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white", metadata={"Software": None})


def _over_training(axes: Axes, variant: Variant, shown: Sequence[Variant], quality: str) -> None:
    curves = list(curves_of(variant).values())
    if not curves:
        _draw_points(axes, variant, shown, "train s", quality)
        return
    mean, look = mean_curve(curves), _look(shown, variant)
    dashes = _DASHES_OF_KIND.get(styles(shown)[variant.name].kind, "-.")
    axes.plot(mean.seconds, mean.psnr, linestyle=dashes, markevery=[len(mean.seconds) - 1], **look)


def _draw_points(axes: Axes, variant: Variant, shown: Sequence[Variant], cost: str, quality: str) -> None:
    """Draw the mean, and every run small and pale."""
    points, look = _points(variant, cost, quality), _look(shown, variant)
    if not points.empty:
        axes.scatter(points["cost"], points["quality"], s=8, color=look["color"], alpha=0.5)
        axes.scatter(*_mean_point(points), s=44, zorder=3, **look)


def _look(shown: Sequence[Variant], variant: Variant) -> dict[str, Any]:
    style, busy = styles(shown), variant.busy("frames") or variant.busy("training")
    label = f"{variant.title} (machine not quiet)" if busy else variant.title
    return {"color": _paint(style, variant), "marker": style[variant.name].marker, "label": label}
