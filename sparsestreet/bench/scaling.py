"""``sparsestreet bench scaling``: time against work, from a thousand to millions of splats, and a line fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from sparsestreet.bench.figures import draw_scaling
from sparsestreet.bench.fit import Line, fit_line
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import OpTimes, TimingBudget, leaves, time_op
from sparsestreet.ops.settings import SplatSettings

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
