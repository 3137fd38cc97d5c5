"""Runs the pixel kernels of a view: one over whole tiles and, if there may be long ones, some over parts."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton import blend, blend_backward
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.parts import PartLayers, merge_parts, thin_parts
from sparsestreet.ops.triton.screen import Screen, given_or
from sparsestreet.ops.triton.view import KernelView

ONE_WARP = {"num_warps": 1}


@dataclass(frozen=True)
class Ends:
    """Where backward begins."""

    transmittance: Float[Tensor, "h w"]
    lasts: Int[Tensor, "h w"] | None
    """Index after the last pair that each pixel was open to; None if no backward pass was expected."""
    parts: PartLayers | None


@dataclass(frozen=True)
class Layers:
    """A blended view."""

    rgb: Float[Tensor, "h w 3"]
    depth_sum: Float[Tensor, "h w"]
    ends: Ends


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of the loss by the layers; a missing one is 0."""

    rgb: Float[Tensor, "h w 3"]
    transmittance: Float[Tensor, "h w"]
    depth_sum: Float[Tensor, "h w"] | None


def blend_view(screen: Screen, view: KernelView, lasts: bool) -> Layers:
    """Blends all tiles; ``lasts``: whether a backward pass will follow."""
    lists, shape, limit = screen.lists, (view.camera.height, view.camera.width), view.transmittance_min
    rgb = screen.records.new_empty(*shape, 3)
    transmittance, depth_sum = screen.records.new_empty(shape), screen.records.new_empty(shape)
    last = lists.begins.new_empty(shape) if lasts else None
    layers = (rgb, transmittance, depth_sum, given_or(last, lists.begins))

    def blend_each(*arguments: Tensor, split: bool) -> None:
        launch(
            blend.blend_tiles, len(arguments[0]), 1,
            screen.records, lists.pair_rows, *arguments, *pixel_arguments(view), limit,
            EXCLUSIVE=view.exclusive, DEPTH=True, LASTS=lasts, PARTS=split,
            options=ONE_WARP | {"maxnreg": blend.registers(view.exclusive)},
        )  # fmt: skip

    parts = lists.parts
    whole_ends = lists.ends if parts is None else parts.whole_ends
    blend_each(lists.begins, whole_ends, lists.order, lists.order, transmittance, *layers, split=False)
    if parts is None:
        return Layers(rgb, depth_sum, Ends(transmittance, last, None))
    part = PartLayers.empty(parts, rgb)
    part_layers = (part.rgb, part.transmittance, part.depth_sum, part.lasts)
    launch(
        thin_parts, len(parts), 1,
        screen.records, lists.pair_rows, parts.tiles, parts.begins, parts.ends, part.products,
        *pixel_arguments(view), limit, options=ONE_WARP,
    )  # fmt: skip
    blend_each(parts.begins, parts.ends, parts.tiles, parts.firsts, part.products, *part_layers, split=True)
    launch(
        merge_parts, len(parts), 1,
        parts.tiles, parts.firsts, parts.nexts, part.products, *part_layers, *layers,
        *pixel_arguments(view)[:3], limit, LASTS=lasts, options=ONE_WARP,
    )  # fmt: skip
    return Layers(rgb, depth_sum, Ends(transmittance, last, part))


def differentiate_view(
    screen: Screen, view: KernelView, ends: Ends, v: Cotangents, absolute: bool
) -> Float[Tensor, "p 12"]:
    """A slot of gradients for each pair; ``absolute``: with the absolute gradients of the screen means."""
    lists, depth, passed = screen.lists, v.depth_sum is not None, ends.transmittance
    slots = passed.new_empty(lists.sizes.pairs, blend_backward.SLOT_LENGTH)

    def differentiate_each(begins: Tensor, stops: Tensor, tiles: Tensor, *part: Tensor, split: bool) -> None:
        launch(
            blend_backward.blend_tiles_backward, len(begins), 1,
            screen.records, lists.pair_rows, lists.slots, begins, stops, tiles, passed, ends.lasts, *part,
            v.rgb, v.transmittance, given_or(v.depth_sum, passed), slots, *pixel_arguments(view),
            DEPTH=depth, ABSOLUTE=absolute, PARTS=split,
            options=ONE_WARP | {"maxnreg": blend_backward.registers(depth)},
        )  # fmt: skip

    parts, part = lists.parts, ends.parts
    unread = (lists.order, passed, passed, passed, lists.order)
    whole_ends = lists.ends if parts is None else parts.whole_ends
    differentiate_each(lists.begins, whole_ends, lists.order, *unread, split=False)
    if parts is not None:
        differentiate_each(
            parts.begins, parts.ends, parts.tiles,
            parts.nexts, part.rgb, part.depth_sum, part.transmittance, part.lasts, split=True,
        )  # fmt: skip
    return slots


def pixel_arguments(view: KernelView) -> tuple[int, int, int, float]:
    """Width, height, columns of tiles, and the largest alpha."""
    return view.camera.width, view.camera.height, view.tiles[0], view.settings.alpha_max
