"""Runs the pixel kernels of a view: over whole tiles and, if there may be long ones, over parts (parts.py)."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton import blend, blend_backward
from sparsestreet.ops.triton.compose import Split, compose
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.lists import Lists
from sparsestreet.ops.triton.parts import PartLayers, Parts
from sparsestreet.ops.triton.screen import Screen, given_or
from sparsestreet.ops.triton.view import KernelView

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


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of the loss by what is blended, before it is composed; a missing one is 0."""

    rgb: Float[Tensor, "h w 3"]
    transmittance: Float[Tensor, "h w"]
    depth_sum: Float[Tensor, "h w"] | None


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
        neighbors, split = (parts.firsts, parts.nexts, part.products), Split(parts, part, limit)
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
    alpha = compose(rgb, transmittance, depth_sum, background, last, split)
    return Layers(rgb, alpha, depth_sum, Ends(transmittance, last, part))


def differentiate_view(
    screen: Screen, view: KernelView, ends: Ends, v: Cotangents, absolute: bool
) -> Float[Tensor, "p s"]:
    """Return a slot of gradients for each pair; ``absolute``: with the absolute gradients of the screen means."""
    lists, depth, passed = screen.lists, v.depth_sum is not None, ends.transmittance
    slots = passed.new_empty(lists.sizes.pairs, blend_backward.slot_length(screen.gated))
    parts, part = lists.parts, ends.parts
    part_count = 0 if parts is None else len(parts)
    nexts, part_layers = lists.order, (passed, passed, passed, lists.order)
    if parts is not None and part is not None:
        nexts, part_layers = parts.nexts, (part.rgb, part.depth_sum, part.transmittance, part.lasts)

    launch(
        blend_backward.blend_tiles_backward, len(lists.order) + part_count, 1,
        screen.records, lists.pair_rows, lists.slots, *work_tables(lists), nexts, passed, ends.lasts, *part_layers,
        v.rgb, v.transmittance, given_or(v.depth_sum, passed), slots,
        *sizes(view, parts), view.settings.alpha_max,
        DEPTH=depth, ABSOLUTE=absolute, GATED=screen.gated, TOGETHER=parts is not None,
        options=ONE_WARP | {"maxnreg": blend_backward.registers(depth, screen.gated)},
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
