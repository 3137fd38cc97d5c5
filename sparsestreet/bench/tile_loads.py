"""How a view's (splat, tile) pairs lie on its tiles: a kernel takes as long as its longest chain of them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sparsestreet.ops.settings import SplatSettings
from sparsestreet.types import Camera, Gaussians


@dataclass(frozen=True)
class TileLoads:
    """Pairs of the tiles of one view, and of the parts that its long tiles are split into."""

    mean: float
    """Pairs of a tile, empty ones included."""
    median: float
    longest: int
    split: int
    """Tiles that are computed in parts."""
    parts: int
    longest_part: int
    """0 without parts."""


@torch.no_grad()
def loads_of(gaussians: Gaussians, camera: Camera, settings: SplatSettings, backend: str) -> TileLoads | None:
    """Counts the pairs of each tile and each part; None for backends other than Triton's. Waits for the device."""
    if backend != "triton":
        return None
    # Triton is imported only where it is used.
    from sparsestreet.ops.triton.screen import project
    from sparsestreet.ops.triton.view import KernelView

    lists = project(gaussians, KernelView(camera, settings)).lists
    lengths = lists.ends - lists.begins
    if lists.parts is None:
        return loads(lengths, lengths[:0], 0)
    split = int((lists.parts.whole_ends < lists.ends).sum())
    return loads(lengths, lists.parts.ends - lists.parts.begins, split)


def loads(tiles: Tensor, parts: Tensor, split: int) -> TileLoads:
    """From the pairs of each tile and of each part; parts without pairs are room that was not needed."""
    parts = parts[parts > 0]
    ordered = tiles.sort().values
    middle = (ordered[(len(tiles) - 1) // 2] + ordered[len(tiles) // 2]) / 2
    longest = int(ordered[-1])
    longest_part = max(parts.tolist(), default=0)
    return TileLoads(float(tiles.double().mean()), float(middle), longest, split, len(parts), longest_part)
