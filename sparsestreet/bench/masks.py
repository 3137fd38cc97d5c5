"""``sparsestreet bench masks``: what a temporal mask's network costs per frame, and what its bits save."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.timing import TimeSpread, TimingBudget, spread
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.gaussians import init_gaussians
from sparsestreet.scene.masks import Mask, MaskScope, TemporalMaskSettings
from sparsestreet.scene.masks.temporal import TemporalMask

ROWS = (5_000, 50_000)
"""Numbers of rows: a few people of a small street, and K_min of the paper's people."""
FRAMES = 150
"""Number of training frames. A log of the Waymo Open Dataset has about 200 frames, at least a tenth held out."""


@dataclass(frozen=True)
class MaskTimes:
    """Times of computing M of all rows at one time, by the network and by its baked bits."""

    rows: int
    frames: int
    network: TimeSpread
    bits: TimeSpread
    bytes_of_bits: int


def run_masks(
    sizes: Sequence[int], frames: int, budget: TimingBudget, file: RecordFile, say: Callable[[str], None] = print
) -> None:
    """Times the same mask before and after it is baked."""
    for count in sizes:
        mask, rows = _masked_rows(count, frames)
        network = _time(mask, rows, budget)
        baked, buffers = mask.finish(rows)
        for name, values in buffers.items():
            rows.register_buffer(name, values)
        record = MaskTimes(count, frames, network, _time(baked, rows, budget), sum(map(_bytes, buffers.values())))
        file.write("masks", record)
        say(
            f"{count:7,} Gaussians, {frames} frames: network {network}; bits {record.bits}, {record.bytes_of_bits:,} "
            f"bytes; {network.median - record.bits.median:.2f} ms saved a frame"
        )


@torch.no_grad()
def _time(mask: Mask, rows: Rows, budget: TimingBudget) -> TimeSpread:
    moments, seconds = iter(range(10**9)), []

    def run() -> None:
        start = time.perf_counter()
        mask.multipliers(rows, next(moments) % FRAMES / (FRAMES - 1))
        seconds.append(time.perf_counter() - start)

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    return spread(seconds)


def _masked_rows(count: int, frames: int) -> tuple[TemporalMask, Rows]:
    """Rows in a box of 2 m, and a temporal mask with an untrained network."""
    generator = torch.Generator().manual_seed(0)
    scope = MaskScope.whole([frame / (frames - 1) for frame in range(frames)], torch.zeros(3), 1.0)
    mask = TemporalMaskSettings(sparsity_weight=1.0e-5).build(0, scope)
    rows = init_gaussians(
        2 * torch.rand(count, 3, generator=generator) - 1,
        torch.full((count, 3), 0.5),
        torch.full((count,), 0.02),
        opacities=torch.full((count,), 0.5),
        sh_degree=3,
        generator=generator,
        mask_columns=mask.initial_columns(count),
    )
    return mask, rows


def _bytes(values: Tensor) -> int:
    return values.numel() * values.element_size()
