"""How much a view gives the pixel kernels to do: what a benchmark divides times by. Waits for the device."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton.blend import LOOK_LENGTH, PIXEL_COUNT
from sparsestreet.ops.triton.pixels import blend_view
from sparsestreet.ops.triton.screen import project
from sparsestreet.ops.triton.view import TILE_SIZE, View
from sparsestreet.types import Camera, Gaussians


@torch.no_grad()
def count_work(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> tuple[int, int]:
    """(splat, tile) pairs of one view and (splat, pixel) samples that its forward pass computes.

    The walk over a tile ends with the 32 pairs in which its last pixel is finished. Long tiles are counted as if they
    were in one piece: that the light through their parts is computed twice is not in the number.
    """
    view = View(camera, settings)
    screen = project(gaussians, view)
    lists = screen.lists
    counts, seen = lists.ends - lists.begins, _last_of_tiles(blend_view(screen, view, lasts=True).ends.lasts, view)
    seen = torch.where(counts > 0, seen - lists.begins, 0)
    walked = torch.minimum(-(-seen // LOOK_LENGTH) * LOOK_LENGTH, counts)
    return len(lists.slots), int(walked.sum()) * PIXEL_COUNT


def _last_of_tiles(lasts: Tensor, view: View) -> Tensor:
    columns, rows = view.tiles
    padded = pad(lasts, (0, columns * TILE_SIZE - lasts.shape[1], 0, rows * TILE_SIZE - lasts.shape[0]))
    return padded.view(rows, TILE_SIZE, columns, TILE_SIZE).amax((1, 3)).flatten()
