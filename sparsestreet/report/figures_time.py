"""Figures of a sweep over time: held-out quality, counts, and the parts of a frame's milliseconds."""

import statistics
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from sparsestreet.pictures.history import count_curves, marks
from sparsestreet.records.costs import COSTS
from sparsestreet.records.ledger import LEDGER
from sparsestreet.report.arms import Arm
from sparsestreet.report.curves import curves_of_runs
from sparsestreet.report.figures import (
    COLORS,
    GREY,
    LEGEND,
    Says,
    Style,
    legend_below,
    panels,
    short,
    styles,
    write_svg,
)

_MOST_BESIDE_CURVES = 6
"""Largest number of names in a legend that stands within a panel."""


def held_out_over_time(arms: Sequence[Arm], path: Path) -> bool:
    """Draws held-out PSNR over training seconds, a panel a method, a line a run. Returns whether a run has a curve."""
    found = {arm.name: [curve for some in curves_of_runs(arm).values() for curve in some] for arm in arms}
    drawn = [arm for arm in arms if found[arm.name]]
    if not drawn:
        return False
    methods = list(dict.fromkeys(arm.plain_label for arm in drawn))
    figure, axes = panels(len(methods))
    says: Says = {}
    look = styles(arms)
    for one, method in zip(axes, methods, strict=True):
        for arm in _of(drawn, method):
            for curve in found[arm.name]:
                name = f"curve {len(says)}"
                one.plot(curve.seconds, curve.psnr, **_line(look[arm.name]), marker=".", markersize=3, gid=name)
                looks = zip(curve.seconds, curve.psnr, strict=True)
                says[name] = [f"{arm.name}: {psnr:.3f} dB after {at:.1f} s" for at, psnr in looks]
        _finish(one, method, "training seconds")
    axes[0].set_ylabel("held-out PSNR, dB")
    _legends(figure, axes)
    write_svg(figure, path, says)
    return True


def counts_over_time(arms: Sequence[Arm], path: Path) -> bool:
    """Draws the number of Gaussians over steps, a panel a method, a line a run; dots mark masks and pruning passes."""
    drawn = [arm for arm in arms if any(LEDGER.exists(record.folder) for record in arm.records)]
    if not drawn:
        return False
    methods = list(dict.fromkeys(arm.plain_label for arm in drawn))
    figure, axes = panels(len(methods))
    look = styles(arms)
    for one, method in zip(axes, methods, strict=True):
        for arm in _of(drawn, method):
            for record in arm.records:
                if LEDGER.exists(record.folder):
                    _counts(one, look[arm.name], record.folder)
        one.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
        _finish(one, method, "step")
    axes[0].set_ylabel("Gaussians")
    _legends(figure, axes)
    write_svg(figure, path)
    return True


def _counts(axes: Axes, look: Style, folder: Path) -> None:
    changes = LEDGER.read(folder)
    steps, nodes = count_curves(changes)
    total = [sum(values) for values in zip(*nodes.values(), strict=True)]
    axes.plot(steps, total, drawstyle="steps-post", **_line(look))
    at = dict(zip(steps, total, strict=True))
    taken = sorted({step for step, _ in marks(changes)})
    axes.plot(taken, [at[step] for step in taken], ".", markersize=4, color=look.color, label="_")


def frame_waterfall(arms: Sequence[Arm], path: Path) -> bool:
    """Draws the additional time of a frame with each node and effect, a bar an arm. Returns whether a run has it."""
    costs = {arm.name: _frame_costs(arm) for arm in arms}
    drawn = [arm for arm in arms if costs[arm.name]]
    if not drawn:
        return False
    parts = list(dict.fromkeys(part for arm in drawn for part in costs[arm.name]))
    titles = [textwrap.wrap(arm.title, 40) for arm in drawn]
    # A bar is as high as the most lines of a name, which would run into its neighbors'.
    figure, (axes,) = panels(1, width=7.4, height=1.1 + max(0.34, 0.16 * max(map(len, titles)) + 0.08) * len(drawn))
    for row, arm in enumerate(drawn):
        left = 0.0
        for part, ms in costs[arm.name].items():
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
    axes.set_xlabel("milliseconds that a frame takes longer with it")
    figure.legend(loc="outside lower center", ncols=5, **LEGEND)
    write_svg(figure, path)
    return True


def _frame_costs(arm: Arm) -> dict[str, float]:
    """Returns node or effect -> mean milliseconds over the runs that recorded it."""
    found: dict[str, list[float]] = {}
    for costs in filter(None, (COSTS.find(record.folder) for record in arm.records)):
        parts = {name: node.ms for name, node in costs.nodes.items()}
        for part, ms in (parts | {f"effect: {name}": ms for name, ms in costs.effects.items()}).items():
            found.setdefault(part, []).append(ms)
    return {part: statistics.fmean(values) for part, values in found.items()}


def _of(arms: Sequence[Arm], method: str) -> list[Arm]:
    return [arm for arm in arms if arm.plain_label == method]


def _line(look: Style) -> dict[str, Any]:
    return {"color": look.color, "linestyle": look.dashes, "linewidth": 1.2, "alpha": 0.85, "label": look.kind}


def _finish(axes: Axes, title: str, x_label: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x_label)


def _legends(figure: Figure, axes: Sequence[Axes]) -> None:
    """Adds a legend to each panel, or one below all of them if it would hide the curves."""
    named = [dict(zip(*reversed(one.get_legend_handles_labels()), strict=True)) for one in axes]
    if max(map(len, named)) <= _MOST_BESIDE_CURVES:
        for one, once in zip(axes, named, strict=True):
            one.legend(once.values(), once.keys(), **LEGEND)
        return
    once = {name: handle for some in named for name, handle in some.items()}
    legend_below(figure, list(once.values()))
