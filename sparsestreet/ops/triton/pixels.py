"""Runs the pixel kernels of a view: over whole tiles and, if there may be long ones, over parts (parts.py)."""

from dataclasses import dataclass
from functools import partial

import torch
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.raster import MIN_ALPHA
from sparsestreet.ops.triton import blend, gradients
from sparsestreet.ops.triton.blend import PIXELS
from sparsestreet.ops.triton.launch import constant, jit, launch
from sparsestreet.ops.triton.lists import Lists
from sparsestreet.ops.triton.parts import PartLayers, Parts, merged
from sparsestreet.ops.triton.screen import Screen, given_or
from sparsestreet.ops.triton.view import TILE, TILE_SIZE, KernelView

_BLOCK = 512
_OPTIONS = {"enable_fp_fusion": False}
LEAST = constant(MIN_ALPHA)


def compose(
    rgb: Float[Tensor, "h w 3"],
    transmittance: Float[Tensor, "h w"],
    depth_sum: Float[Tensor, "h w"],
    background: Float[Tensor, "..."] | None,
    lasts: Int[Tensor, "h w"] | None = None,
    split: tuple[Parts, PartLayers] | None = None,
    limit: float = 0.0,
) -> Float[Tensor, "h w"]:
    """Return alpha; put the background [3] or [h, w, 3] behind ``rgb`` and turn ``depth_sum`` into a depth, both in
    place.

    The pixels of ``split`` tiles it first adds up from their parts, with where they end if ``lasts`` are given; at the
    light ``limit`` a pixel is finished."""
    alpha, (height, width) = transmittance.new_empty(transmittance.shape), transmittance.shape
    columns, tables = -(-width // TILE_SIZE), (rgb,) * 7
    if split is not None:
        parts, part = split
        tables = (
            parts.of_tiles, parts.nexts, part.products, part.rgb, part.transmittance, part.depth_sum, part.lasts,
        )  # fmt: skip
    launch(
        compose_pixels, columns * -(-height // TILE_SIZE), 1,
        rgb, transmittance, depth_sum, given_or(lasts, rgb), given_or(background, rgb),
        alpha, *tables, width, height, columns, limit,
        PARTS=split is not None, LASTS=split is not None and lasts is not None, **_behind(background), options=_OPTIONS,
    )  # fmt: skip
    return alpha


def decompose(
    passed: Float[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    background: Float[Tensor, "..."] | None,
    v_rgb: Tensor,
    v_alpha: Tensor | None,
    v_depth: Tensor | None,
    background_too: bool,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gradients of the transmittance ``passed``, of the sum of depths (None: not asked for), and of the background."""
    if v_alpha is None and v_depth is None and background is None:
        return torch.zeros_like(passed), None, None
    v_passed, v_background = torch.empty_like(passed), torch.empty_like(v_rgb) if background_too else None
    v_depth_sum = None if v_depth is None else torch.empty_like(passed)
    unread = [given_or(given, passed) for given in (v_alpha, v_depth, background, v_background, v_depth_sum)]
    launch(
        decompose_pixels, passed.numel(), _BLOCK,
        passed, depth, v_rgb, *unread, v_passed, passed.numel(),
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


ONE_WARP = {"num_warps": 1}
WHOLE_TILES = {"REST": False, "TOGETHER": False}
TOGETHER = {"REST": False, "TOGETHER": True}
REST = {"REST": True, "TOGETHER": False}


@dataclass(frozen=True)
class Ends:
    """Where backward begins."""

    transmittance: Float[Tensor, "h w"]
    lasts: Int[Tensor, "h w"] | None
    """Index after the last pair that each pixel was open to; None if no backward pass was expected."""
    parts: PartLayers | None


@dataclass(frozen=True)
class Layers:
    """A blended view: the images of a Rendering."""

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    ends: Ends


def blend_view(screen: Screen, view: KernelView, lasts: bool, background: Float[Tensor, "..."] | None = None) -> Layers:
    """Blends all tiles over a background; ``lasts``: whether a backward pass will follow."""
    lists, shape, new = screen.lists, (view.camera.height, view.camera.width), screen.records.new_empty
    rgb, transmittance, depth_sum = new((*shape, 3)), new(shape), new(shape)
    last, parts, limit = lists.begins.new_empty(shape) if lasts else None, lists.parts, view.transmittance_min
    layers = part_layers = (rgb, transmittance, depth_sum, given_or(last, lists.begins))
    neighbors, part, split = (lists.order, lists.order, transmittance), None, None
    if parts is not None:
        part = PartLayers.empty(parts, rgb)
        part_layers = (part.rgb, part.transmittance, part.depth_sum, part.lasts)
        neighbors, split = (parts.firsts, parts.nexts, part.products), (parts, part)
    tables = (screen.records, lists.pair_rows, *work_tables(lists), *neighbors, *layers, *part_layers)
    numbers = (*sizes(view, parts), view.settings.alpha_max, limit)
    tiles, part_count = lists.order.shape[0], numbers[3]
    options = ONE_WARP | {"maxnreg": blend.registers(screen.gated)}

    def blend_each(count: int, work: dict[str, bool]) -> None:
        launch(
            blend.blend_tiles, count, 1, *tables, *numbers,
            EXCLUSIVE=view.exclusive, DEPTH=True, LASTS=lasts, GATED=screen.gated, **work, options=options,
        )  # fmt: skip

    if parts is None or part is None:
        blend_each(tiles, WHOLE_TILES)
    else:
        # Whole tiles, first parts and what later ones let through; then these. In a launch of its own, each would wait
        # for the one before.
        blend_each(tiles + part_count, TOGETHER)
        blend_each(part_count, REST)
    alpha = compose(rgb, transmittance, depth_sum, background, last, split, limit)
    return Layers(rgb, alpha, depth_sum, Ends(transmittance, last, part))


def differentiate_view(
    screen: Screen,
    view: KernelView,
    ends: Ends,
    v_rgb: Float[Tensor, "h w 3"],
    v_transmittance: Float[Tensor, "h w"],
    v_depth_sum: Float[Tensor, "h w"] | None,
    absolute: bool,
) -> Float[Tensor, "p s"]:
    """Return a slot of gradients for each pair; ``absolute``: with the absolute gradients of the screen means."""
    lists, depth, passed = screen.lists, v_depth_sum is not None, ends.transmittance
    slots = passed.new_empty(lists.sizes.pairs, gradients.slot_length(screen.gated))
    parts, part = lists.parts, ends.parts
    part_count = 0 if parts is None else len(parts)
    nexts, part_layers = lists.order, (passed, passed, passed, lists.order)
    if parts is not None and part is not None:
        nexts, part_layers = parts.nexts, (part.rgb, part.depth_sum, part.transmittance, part.lasts)
    launch(
        gradients.blend_tiles_backward, len(lists.order) + part_count, 1,
        screen.records, lists.pair_rows, lists.slots, *work_tables(lists), nexts, passed, ends.lasts, *part_layers,
        v_rgb, v_transmittance, given_or(v_depth_sum, passed), slots,
        *sizes(view, parts), view.settings.alpha_max,
        DEPTH=depth, ABSOLUTE=absolute, GATED=screen.gated, TOGETHER=parts is not None,
        options=ONE_WARP | {"maxnreg": gradients.registers(depth, screen.gated)},
    )  # fmt: skip
    return slots


def work_tables(lists: Lists) -> tuple[Tensor, ...]:
    """What a program works on (programs.py): tiles, then parts; where there are none, tables that are not read."""
    parts = lists.parts
    if parts is None:
        return lists.begins, lists.ends, *(lists.order,) * 5
    return lists.begins, parts.whole_ends, lists.order, parts.ahead, parts.tiles, parts.begins, parts.ends


def sizes(view: KernelView, parts: Parts | None) -> tuple[int, int, int, int]:
    """Width, height, columns of tiles, and the room for parts."""
    return *pixel_arguments(view)[:3], 0 if parts is None else len(parts)


def pixel_arguments(view: KernelView) -> tuple[int, int, int, float]:
    """Width, height, columns of tiles, and the largest alpha."""
    return view.camera.width, view.camera.height, view.tiles[0], view.settings.alpha_max
