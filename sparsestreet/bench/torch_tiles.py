"""The blend in vectorized torch, tile by tile: the peer on the CPU, and a second oracle for large scenes.

Splats are listed per 16x16 tile, nearest first. Tiles of similar length are padded to one [tiles, splats, pixels]
block.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.ops.reference import Splats
from sparsestreet.ops.settings import SplatSettings

TILE = 16
_BLOCK_ELEMENTS = 1 << 22


@dataclass(frozen=True)
class Block:
    """Tiles that are blended together; entries past the end of a tile's list are not ``listed``."""

    tiles: Int[Tensor, " t"]
    splats: Int[Tensor, "t k"]
    listed: Bool[Tensor, "t k"]


def blend(
    splats: Splats, width: int, height: int, settings: SplatSettings
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Returns color (premultiplied) and transmittance; splats must come nearest first."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    image = splats.means.new_zeros(tiles_x * tiles_y, TILE * TILE, 4)
    image[..., 3] = 1
    for block in tile_blocks(splats, tiles_x, tiles_y):
        image[block.tiles] = blend_block(splats, block, tiles_x, settings)
    whole = image.reshape(tiles_y, tiles_x, TILE, TILE, 4).transpose(1, 2).reshape(tiles_y * TILE, tiles_x * TILE, 4)
    whole = whole[:height, :width]
    return whole[..., :3], whole[..., 3]


def blend_gradients(
    splats: Splats, width: int, height: int, settings: SplatSettings, cotangent: Float[Tensor, "h w 3"]
) -> dict[str, Tensor]:
    """Gradients of sum(cotangent * color) with respect to means, cholesky, opacities and colors.

    Each block is differentiated as soon as it is blended, so that only one block's graph is in memory.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    padded = torch.nn.functional.pad(cotangent, (0, 0, 0, tiles_x * TILE - width, 0, tiles_y * TILE - height))
    by_tile = padded.reshape(tiles_y, TILE, tiles_x, TILE, 3).transpose(1, 2).reshape(-1, TILE * TILE, 3)
    leaves = {
        name: getattr(splats, name).detach().requires_grad_() for name in ("means", "cholesky", "opacities", "colors")
    }
    graph = replace(splats, **leaves)
    for block in tile_blocks(splats, tiles_x, tiles_y):
        blend_block(graph, block, tiles_x, settings)[..., :3].backward(by_tile[block.tiles])
    return {name: leaf.grad for name, leaf in leaves.items()}


@torch.no_grad()
def tile_blocks(splats: Splats, tiles_x: int, tiles_y: int) -> Iterator[Block]:
    """Lists the splats of each tile their box touches, and yields tiles of similar length together."""
    first = ((splats.means - splats.half_boxes - 0.5) / TILE).floor().long()
    last = ((splats.means + splats.half_boxes - 0.5) / TILE).floor().long()
    limit = torch.tensor([tiles_x - 1, tiles_y - 1])
    first, last = first.clamp(min=0), torch.minimum(last, limit)
    sides = (last - first + 1).clamp(min=0)
    counts = sides.prod(-1)
    splat = torch.repeat_interleave(counts)
    place = torch.arange(len(splat)) - (counts.cumsum(0) - counts)[splat]
    x, y = first[splat, 0] + place % sides[splat, 0], first[splat, 1] + place // sides[splat, 0]
    tile, order = torch.sort(y * tiles_x + x, stable=True)
    listed = splat[order]
    lengths = torch.bincount(tile, minlength=tiles_x * tiles_y)
    begin = lengths.cumsum(0) - lengths
    by_length = torch.argsort(lengths, descending=True)
    by_length = by_length[lengths[by_length] > 0]
    while len(by_length):
        longest = int(lengths[by_length[0]])
        size = max(1, _BLOCK_ELEMENTS // (longest * TILE * TILE))
        tiles, by_length = by_length[:size], by_length[size:]
        entries = torch.arange(longest)[None]
        valid = entries < lengths[tiles][:, None]
        yield Block(tiles, listed[torch.where(valid, begin[tiles][:, None] + entries, 0)], valid)


def blend_block(splats: Splats, block: Block, tiles_x: int, settings: SplatSettings) -> Float[Tensor, "t 256 4"]:
    """Color and transmittance of the pixels of a block's tiles."""
    weights, transmittance = block_weights(splats, block, tiles_x, settings)
    colors = torch.einsum("tkp,tkc->tpc", weights, splats.colors[block.splats])
    return torch.cat((colors, transmittance[..., None]), -1)


def block_weights(
    splats: Splats, block: Block, tiles_x: int, settings: SplatSettings
) -> tuple[Float[Tensor, "t k 256"], Float[Tensor, "t 256"]]:
    """Blend weight of each splat in each pixel, and the light that passes all of them."""
    inside = torch.arange(TILE * TILE)
    x = (block.tiles % tiles_x * TILE)[:, None] + inside % TILE + 0.5
    y = (block.tiles // tiles_x * TILE)[:, None] + inside // TILE + 0.5
    mean, factor = splats.means[block.splats], splats.cholesky[block.splats]
    dx, dy = x[:, None] - mean[..., :1], y[:, None] - mean[..., 1:]
    a = factor[..., :1] * dx + factor[..., 1:2] * dy
    q = a.square() + (factor[..., 2:] * dy).square()
    touched = (q <= splats.reaches[block.splats][..., None]) & block.listed[..., None]
    raw = splats.opacities[block.splats][..., None] * torch.exp(-0.5 * q)
    alpha = torch.where(touched, raw.clamp(max=settings.alpha_max), 0.0)
    passed = (1 - alpha).cumprod(1)
    before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1]), 1)
    still_open = (before if settings.stop == "inclusive" else passed) > settings.transmittance_min
    alpha = torch.where(still_open, alpha, 0.0)
    return alpha * before, (1 - alpha).prod(1)
