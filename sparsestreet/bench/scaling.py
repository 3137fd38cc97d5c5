"""``sparsestreet bench scaling``: time against work, from a thousand to millions of splats, and a line fit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure

from sparsestreet.bench.figures import save_figure
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import Size, frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import OpTimes, TimingBudget, leaves, time_op
from sparsestreet.ops.settings import SplatSettings


@dataclass(frozen=True)
class Line:
    """y = intercept + slope x."""

    slope: float
    intercept: float
    r_squared: float
    """Share of the (weighted) variance that the line explains; 1 where the points do not vary."""

    def at(self, x: float) -> float:
        return self.intercept + self.slope * x


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line:
    """Least squares of relative residuals (weights 1/y^2), so that small times count as much as large ones.

    Raises ValueError for fewer than two different x, or a y that is not positive.
    """
    if not all(b > 0 for b in y):
        raise ValueError(f"relative residuals need values > 0, got {min(y)}: measure longer")
    weights = [1 / b**2 for b in y]

    def mean(values: Sequence[float]) -> float:
        return sum(w * value for w, value in zip(weights, values, strict=True)) / sum(weights)

    if len(set(x)) < 2:
        raise ValueError(f"a line needs at least two different x, got {sorted(set(x))}: measure more sizes")
    mean_x, mean_y = mean(x), mean(y)
    covariance = mean([(a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)])
    slope = covariance / mean([(a - mean_x) ** 2 for a in x])
    line = Line(slope, mean_y - slope * mean_x, 1.0)
    total = mean([(b - mean_y) ** 2 for b in y])
    residual = mean([(b - line.at(a)) ** 2 for a, b in zip(x, y, strict=True)])
    return line if total == 0 else Line(line.slope, line.intercept, 1 - residual / total)


ROWS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)
DENSITY = 0.4
"""Splats per pixel, equal for all numbers of splats. At a higher density pixels stop earlier, so that time would grow
more slowly than the number of pairs."""
LARGE = Size(1920, 1280, 1_000_000)


@dataclass(frozen=True)
class ScalingRecord:
    """One number of splats; times are milliseconds."""

    rows: int
    width: int
    height: int
    fitted: bool
    """Whether this point is part of the fit; the large view is not."""
    times: OpTimes


@dataclass(frozen=True)
class FitRecord:
    """Median milliseconds = intercept + slope x pairs, by least squares."""

    part: str
    line: Line
    largest_relative_residual: float
    """The largest over all points. It comes from the smallest views, where the cost of a call is most of the time."""


def run_scaling(
    rows: Sequence[int],
    large: Size | None,
    budget: TimingBudget,
    file: RecordFile,
    folder: Path,
    say: Callable[[str], None] = print,
) -> None:
    """Times the C++ backend at every number of splats, fits forward and backward, and draws."""
    records = [_measure(sized(count), True, budget, file, say) for count in rows]
    if large is not None:
        _measure(large, False, budget, file, say)
    pairs = [float(count) for record in records if (count := record.times.pairs) is not None]  # counted: on the CPU
    times = {part: [record.times.stages[part].median for record in records] for part in ("forward", "backward")}
    lines = {}
    for part, values in times.items():
        lines[part] = fit_line(pairs, values)
        residual = max(abs(lines[part].at(x) / y - 1) for x, y in zip(pairs, values, strict=True))
        file.write("fit", FitRecord(part, lines[part], residual))
        say(
            f"{part}: {lines[part].intercept:.3g} ms + {1e6 * lines[part].slope:.4g} ns a pair, "
            f"R^2 = {lines[part].r_squared:.5f}"
        )
    for path in draw_scaling(pairs, times, lines, folder):
        say(f"drawn: {path}")


def sized(rows: int) -> Size:
    """A 3:2 image with DENSITY splats per pixel; its sides are multiples of 16."""
    side = (rows / DENSITY / 1.5) ** 0.5
    width, height = (max(16, round(factor * side / 16) * 16) for factor in (1.5, 1.0))
    return Size(width, height, rows)


def _measure(
    size: Size, fitted: bool, budget: TimingBudget, file: RecordFile, say: Callable[[str], None]
) -> ScalingRecord:
    camera = frustum_camera(size.width, size.height)
    rows = leaves(frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16), torch.float32)
    times = time_op(rows, camera, SplatSettings(), "cpu", budget)
    record = ScalingRecord(size.rows, size.width, size.height, fitted, times)
    file.write("scaling", record)
    stages = times.stages
    say(
        f"{size.rows:>9} splats {size.width}x{size.height}: {times.pairs} pairs, forward {stages['forward']}, "
        f"backward {stages['backward']}"
    )
    return record


def draw_scaling(
    work: Sequence[float], times: Mapping[str, Sequence[float]], lines: dict[str, Line], folder: Path
) -> list[Path]:
    """Milliseconds of each part against (splat, tile) pairs, with its straight line; both axes logarithmic."""
    figure = Figure(figsize=(7.2, 4.6), dpi=130, layout="constrained")
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
    return save_figure(figure, folder, "scaling")
