"""The last step of a rendering and the first of its gradient: background, alpha and expected depth of each pixel.

The last step also adds up the parts of long tiles (parts.py). Otherwise both have the bits of ops/splat.py, where torch
takes five passes over the image, and eight back.
"""

from dataclasses import dataclass
from functools import partial

import torch
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.raster import LEAST_ALPHA
from sparsestreet.ops.triton.blend import PIXELS
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.parts import PartLayers, Parts, merged
from sparsestreet.ops.triton.view import TILE, TILE_SIZE

_BLOCK = 512
_OPTIONS = {"enable_fp_fusion": False}
LEAST = constant(LEAST_ALPHA)


@dataclass(frozen=True)
class Composed:
    """What backward needs of a composed image."""

    transmittance: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    background: Float[Tensor, "..."] | None
    """[3] or [h, w, 3]."""


@dataclass(frozen=True)
class Split:
    """Tiles whose pixels are still in parts."""

    parts: Parts
    layers: PartLayers
    limit: float
    """Light at which a pixel is finished."""


def compose(
    rgb: Float[Tensor, "h w 3"],
    transmittance: Float[Tensor, "h w"],
    depth_sum: Float[Tensor, "h w"],
    background: Float[Tensor, "..."] | None,
    lasts: Int[Tensor, "h w"] | None = None,
    split: Split | None = None,
) -> Float[Tensor, "h w"]:
    """Returns alpha; puts the background behind ``rgb`` and turns ``depth_sum`` into a depth, both in place.

    The pixels of ``split`` tiles it first adds up from their parts, with where they end if ``lasts`` are given."""
    alpha, (height, width) = transmittance.new_empty(transmittance.shape), transmittance.shape
    columns = -(-width // TILE_SIZE)
    tables, limit = (rgb,) * 7, 0.0
    if split is not None:
        part, limit = split.layers, split.limit
        tables = (
            split.parts.of_tiles, split.parts.nexts,
            part.products, part.rgb, part.transmittance, part.depth_sum, part.lasts,
        )  # fmt: skip
    launch(
        compose_pixels, columns * -(-height // TILE_SIZE), 1,
        rgb, transmittance, depth_sum, rgb if lasts is None else lasts, rgb if background is None else background,
        alpha, *tables, width, height, columns, limit,
        PARTS=split is not None, LASTS=split is not None and lasts is not None, **_behind(background), options=_OPTIONS,
    )  # fmt: skip
    return alpha


def decompose(
    composed: Composed, v_rgb: Tensor, v_alpha: Tensor | None, v_depth: Tensor | None, background_too: bool
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gradients of the transmittance, of the sum of depths (None: none was asked for), and of the background."""
    passed, background = composed.transmittance, composed.background
    if v_alpha is None and v_depth is None and background is None:
        return torch.zeros_like(passed), None, None
    v_passed, v_background = torch.empty_like(passed), torch.empty_like(v_rgb) if background_too else None
    v_depth_sum = None if v_depth is None else torch.empty_like(passed)
    unread = [passed if given is None else given for given in (v_alpha, v_depth, background, v_background, v_depth_sum)]
    launch(
        decompose_pixels, passed.numel(), _BLOCK,
        passed, composed.depth, v_rgb, *unread, v_passed, passed.numel(),
        ALPHA=v_alpha is not None, DEPTH=v_depth is not None, COLORS=background_too, **_behind(background),
        options=_OPTIONS,
    )  # fmt: skip
    if v_background is not None and background is not None and background.dim() == 1:
        v_background = v_background.sum((0, 1))
    return v_passed, v_depth_sum, v_background


def _behind(background: Tensor | None) -> dict[str, int]:
    """How far the colors of two pixels lie apart; -1: there is no background."""
    return {"APART": -1 if background is None else 3 * (background.dim() == 3)}


@jit
def compose_pixels(
    rgb, transmittance, depth_sum, lasts, background, alpha,
    of_tiles, nexts, products, part_rgb, part_transmittance, part_depth, part_lasts,
    width, height, tiles_x, limit,
    PARTS: tl.constexpr, LASTS: tl.constexpr, APART: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The pixels of one tile, line by line."""
    tl.static_assert(BLOCK == 1)
    tile, p = tl.program_id(0), tl.arange(0, PIXELS)
    x, y = tile % tiles_x * TILE + p % TILE, tile // tiles_x * TILE + p // TILE
    inside, at = (x < width) & (y < height), y * width + x
    first = tile
    whole, split = inside, inside
    if PARTS:
        first = tl.load(of_tiles + tile)
        whole, split = inside & (first < 0), inside & (first >= 0)
    passed, depth = tl.load(transmittance + at, whole, 1.0), tl.load(depth_sum + at, whole, 0.0)
    red, green, blue = tl.zeros_like(passed), tl.zeros_like(passed), tl.zeros_like(passed)
    if PARTS or APART >= 0:
        to = rgb + 3 * at
        red, green, blue = tl.load(to, whole, 0.0), tl.load(to + 1, whole, 0.0), tl.load(to + 2, whole, 0.0)
    if PARTS:
        layers = (products, part_rgb, part_transmittance, part_depth, part_lasts)
        pixel = (passed, red, green, blue, depth, p)
        passed, red, green, blue, depth, last = merged(first, p, pixel, nexts, *layers, limit, LASTS)
        tl.store(transmittance + at, passed, split)
        if LASTS:
            tl.store(lasts + at, last, split)
    opaque = 1 - passed
    tl.store(alpha + at, opaque, inside)
    tl.store(depth_sum + at, tl.div_rn(depth, tl.maximum(opaque, LEAST)), inside)
    if APART >= 0:
        behind = background + APART * at
        red += passed * tl.load(behind, inside, 0.0)
        green += passed * tl.load(behind + 1, inside, 0.0)
        blue += passed * tl.load(behind + 2, inside, 0.0)
        split = inside
    if PARTS or APART >= 0:
        tl.store(to, red, split)
        tl.store(to + 1, green, split)
        tl.store(to + 2, blue, split)


@partial(jit, do_not_specialize=["pixels"])
def decompose_pixels(
    transmittance, depths, v_rgb, v_alphas, v_depths, background, v_background, v_depth_sum, v_transmittance, pixels,
    ALPHA: tl.constexpr, DEPTH: tl.constexpr, COLORS: tl.constexpr, APART: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """In the order in which torch adds and divides."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = pixel < pixels
    passed = tl.load(transmittance + pixel, given, 1.0)
    opaque, v_opaque = 1 - passed, tl.zeros_like(passed)
    if ALPHA:
        v_opaque = tl.load(v_alphas + pixel, given, 0.0)
    if DEPTH:
        v_depth, least = tl.load(v_depths + pixel, given, 0.0), tl.maximum(opaque, LEAST)
        tl.store(v_depth_sum + pixel, tl.div_rn(v_depth, least), given)
        through = -v_depth * tl.div_rn(tl.load(depths + pixel, given, 0.0), least)
        v_opaque += tl.where(opaque >= LEAST, through, 0.0)
    v_passed = -v_opaque
    if APART >= 0:
        through = tl.zeros_like(passed)
        for i in tl.static_range(3):
            color = tl.load(v_rgb + 3 * pixel + i, given, 0.0)
            through += color * tl.load(background + APART * pixel + i, given, 0.0)
            if COLORS:
                tl.store(v_background + 3 * pixel + i, color * passed, given)
        v_passed += through
    tl.store(v_transmittance + pixel, v_passed, given)
