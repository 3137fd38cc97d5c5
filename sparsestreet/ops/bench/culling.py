"""That leaving out the tiles a splat does not reach changes no pixel: a test of identity, not a point on a curve.

Summed in one order, a term that is exactly zero changes no bit. So the blend over every splat in every tile must
equal, bit for bit, the blend over the tiles' own lists; and a backend with tiles must touch what the dense one touches.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sparsestreet.ops.bench.timing import leaves
from sparsestreet.ops.bench.torch_tiles import TILE, Block, block_weights, tile_blocks
from sparsestreet.ops.reference import Splats, on_screen, visible_rows
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import contribution
from sparsestreet.types import Camera, Gaussians


@dataclass(frozen=True)
class Culling:
    """What culling left out of one view, and whether anything was missed."""

    pairs: int
    """(splat, tile) pairs without culling: visible splats times tiles."""
    pairs_listed: int
    """Pairs that remain in the tiles' lists."""
    pixels_changed: int
    """Pixels whose colour or transmittance differs in any bit between the two (vectorised torch, float64)."""
    rows_touching_other_pixels: int
    """Rows whose number of touched pixels differs between C++ with exact tiles and the dense reference, float64."""

    def __str__(self) -> str:
        return (
            f"{self.pairs_listed} of {self.pairs} pairs blended, {self.pixels_changed} pixels changed, "
            f"{self.rows_touching_other_pixels} rows touch other pixels"
        )


@torch.no_grad()
def compare_culling(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Culling:
    """Blend with and without culling; for small views: without it the memory is splats x pixels."""
    doubled = leaves(gaussians, torch.float64)
    splats = on_screen(doubled, visible_rows(doubled, camera, settings), camera, settings)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    tiles = tiles_x * tiles_y
    every = torch.arange(len(splats.means)).expand(tiles, -1)
    whole = [Block(torch.arange(tiles), every, torch.ones_like(every, dtype=torch.bool))]
    listed = list(tile_blocks(splats, tiles_x, tiles_y))
    images = [_sequential_blend(splats, blocks, tiles, tiles_x, settings) for blocks in (whole, listed)]
    touched = [contribution(doubled, camera, settings=settings, backend=name).pixels for name in ("cpu", "reference")]
    return Culling(
        pairs=len(splats.means) * tiles,
        pairs_listed=sum(int(block.listed.sum()) for block in listed),
        pixels_changed=int((images[0] != images[1]).any(-1).sum()),
        rows_touching_other_pixels=int((touched[0] != touched[1]).sum()),
    )


def _sequential_blend(splats: Splats, blocks: list[Block], tiles: int, tiles_x: int, settings: SplatSettings) -> Tensor:
    """Colour and transmittance of all tiles, summed splat by splat: a matrix product would reorder the sum."""
    image = splats.means.new_zeros(tiles, TILE * TILE, 4)
    image[..., 3] = 1
    for block in blocks:
        weights, transmittance = block_weights(splats, block, tiles_x, settings)
        colors = image.new_zeros(len(block.tiles), TILE * TILE, 3)
        for entry in range(block.splats.shape[1]):
            colors += weights[:, entry, :, None] * splats.colors[block.splats[:, entry]][:, None]
        image[block.tiles] = torch.cat((colors, transmittance[..., None]), -1)
    return image
