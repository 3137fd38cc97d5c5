"""Counts the work of the pixel kernels for a view, by which benchmarks divide times. Waits for the device."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton.pixels import blend_view
from sparsestreet.ops.triton.quadrants import QUADRANT_PIXELS
from sparsestreet.ops.triton.screen import project
from sparsestreet.ops.triton.thin import LOOK_LENGTH
from sparsestreet.ops.triton.view import TILE_SIZE, KernelView
from sparsestreet.types import Camera, Gaussians


@torch.no_grad()
def count_work(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> tuple[int, int]:
    """(splat, tile) pairs of one view and (splat, pixel) samples that its forward pass computes.

    A tile is counted up to the block of 32 pairs in which its last pixel is still open, and for each pair the quadrants
    that it touches. Long tiles count as unsplit, without the second computation of the light through their parts.
    """
    view = KernelView.of(camera, settings)
    screen = project(gaussians, view)
    lists = screen.lists
    counts, seen = lists.ends - lists.begins, _last_of_tiles(blend_view(screen, view, lasts=True).ends.lasts, view)
    seen = torch.where(counts > 0, seen - lists.begins, 0)
    walked = torch.minimum(-(-seen // LOOK_LENGTH) * LOOK_LENGTH, counts)
    touched = (lists.quadrants_of_pairs[:, None] >> torch.arange(4, device=counts.device) & 1).sum(1)
    before = torch.nn.functional.pad(touched.cumsum(0), (1, 0))
    quadrants = before[(lists.begins + walked).long()] - before[lists.begins.long()]
    return len(lists.slots), int(quadrants.sum()) * QUADRANT_PIXELS


def _last_of_tiles(lasts: Tensor, view: KernelView) -> Tensor:
    columns, rows = view.tiles
    padded = pad(lasts, (0, columns * TILE_SIZE - lasts.shape[1], 0, rows * TILE_SIZE - lasts.shape[0]))
    return padded.view(rows, TILE_SIZE, columns, TILE_SIZE).amax((1, 3)).flatten()
