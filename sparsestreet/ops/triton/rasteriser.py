"""The Triton backend as an autograd function over torch tensors.

One forward waits for the device once, for the numbers of visible rows and of pairs (and for whether a value was bad);
backward never waits.
"""

from dataclasses import dataclass

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.raster import Raster
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton import blend, blend_backward, count, records, rows, rows_backward, slots
from sparsestreet.ops.triton import removal as remove
from sparsestreet.ops.triton.launch import is_interpreted, launch
from sparsestreet.ops.triton.lists import Lists, check_pairs, list_tiles
from sparsestreet.ops.triton.view import View
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Camera, Contribution, Gaussians, Removal

ONE_WARP = {"num_warps": 1}


@dataclass(frozen=True)
class Screen:
    """A scene on the screen of one view, as the pixel kernels take it."""

    table: Float[Tensor, " numbers"]
    records: Float[Tensor, "n 12"]
    tile_counts: Tensor
    radii: Float[Tensor, " n"]
    lists: Lists


def rasterise(
    gaussians: Gaussians, screen_offsets: Float[Tensor, "n 2"], camera: Camera, settings: SplatSettings
) -> Raster:
    """Project, sort by tile and blend, in float32. Bitwise the same in every run on one device.

    Rows of opacity 0 are not read: what else they hold is not checked.
    """
    g = gaussians
    _check(g)
    layers = _Blend.apply(
        g.means, g.quaternions, g.scales, g.opacities, g.sh, screen_offsets, g.displacements, View(camera, settings)
    )
    return Raster(*layers)


@torch.no_grad()
def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    _check(gaussians)
    g, view = gaussians, View(camera, settings)
    fields = tuple(field.contiguous() for field in (g.means, g.quaternions, g.scales, g.opacities, g.sh))
    screen = _project(fields, g.displacements, view)
    lists = screen.lists
    counters = screen.records.new_empty(len(lists.slots), count.COUNTER_COUNT)
    launch(
        count.count_tiles_pixels, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, lists.order, counters,
        *_pixel_arguments(view), EXCLUSIVE=view.exclusive, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(len(g), count.COUNTER_COUNT, dtype=torch.float64, device=g.means.device)
    _sum_slots(counters, lists, totals, 4, tl.float64)
    weight, pixels, dominant = totals.unbind(-1)
    return Contribution(weight, pixels.long(), dominant.long())


@torch.no_grad()
def removal(
    gaussians: Gaussians,
    background: Float[Tensor, "h w 3"] | None,
    pixel_weights: Float[Tensor, "h w"] | None,
    camera: Camera,
    settings: SplatSettings,
) -> Removal:
    """How far the view moves when each row alone is taken away, over a background (None: black)."""
    _check(gaussians)
    g, view = gaussians, View(camera, settings)
    fields = tuple(field.contiguous() for field in (g.means, g.quaternions, g.scales, g.opacities, g.sh))
    screen = _project(fields, g.displacements, view)
    lists, (rgb, transmittance, _, lasts) = screen.lists, _blend(screen, view)
    changes = screen.records.new_empty(len(lists.slots), remove.CHANGE_COUNT)
    width, height, *others = _pixel_arguments(view)
    launch(
        remove.remove_from_tiles, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, lasts, lists.order,
        rgb, transmittance, rgb if background is None else background.contiguous(),
        transmittance if pixel_weights is None else pixel_weights.contiguous(), changes, width, height, 1, *others,
        EXCLUSIVE=view.exclusive, BEHIND=background is not None, WEIGHTED=pixel_weights is not None, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(len(g), remove.CHANGE_COUNT, dtype=torch.float64, device=g.means.device)
    _sum_slots(changes, lists, totals, 2, tl.float64)
    # A maximum is the same in any order.
    largest = torch.zeros_like(totals[:, 0])
    largest.scatter_reduce_(0, lists.pair_rows.long(), changes[lists.slots, 0].double(), "amax")
    return Removal(largest, totals[:, 1])


class _Blend(torch.autograd.Function):
    """Five fields and the screen offsets to the layers of a Raster."""

    @staticmethod
    def forward(ctx, means, quaternions, scales, opacities, sh, screen_offsets, displacements, view):
        ctx.set_materialize_grads(False)
        fields = tuple(field.contiguous() for field in (means, quaternions, scales, opacities, sh))
        displacements = None if displacements is None else displacements.contiguous()
        screen = _project(fields, displacements, view)
        rgb, transmittance, depth_sum, lasts = _blend(screen, view)
        ctx.mark_non_differentiable(screen.radii)
        ctx.save_for_backward(*fields, rgb, transmittance, depth_sum)
        ctx.screen, ctx.view, ctx.displacements, ctx.lasts = screen, view, displacements, lasts
        return rgb, transmittance, depth_sum, screen.radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb, v_transmittance, v_depth_sum, _v_radii):
        *fields, rgb, transmittance, depth_sum = ctx.saved_tensors
        screen, view, lists = ctx.screen, ctx.view, ctx.screen.lists
        layers = (rgb, transmittance, depth_sum)
        cotangents = [
            torch.zeros_like(rgb) if v_rgb is None else v_rgb.contiguous(),
            torch.zeros_like(transmittance) if v_transmittance is None else v_transmittance.contiguous(),
            transmittance if v_depth_sum is None else v_depth_sum.contiguous(),
        ]
        depth = v_depth_sum is not None
        gradients = rgb.new_empty(len(lists.slots), blend_backward.SLOT_LENGTH)
        width, height, *others = _pixel_arguments(view)
        launch(
            blend_backward.blend_tiles_backward, len(lists.order), 1,
            screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, ctx.lasts, lists.order,
            *layers, *cotangents, gradients, width, height, 1, *others,
            EXCLUSIVE=view.exclusive, DEPTH=depth, ABSOLUTE=ctx.needs_input_grad[5],
            options=ONE_WARP | {"maxnreg": blend_backward.registers(depth, view.exclusive)},
        )  # fmt: skip
        sums = rgb.new_empty(len(fields[0]), blend_backward.SLOT_LENGTH)
        _sum_slots(gradients, lists, sums, 16, tl.float32)
        outputs = [torch.empty_like(field) for field in fields]
        v_screen = rgb.new_empty(len(fields[0]), 2)
        launch(
            rows_backward.project_rows_backward, len(fields[0]), rows.block_of(view),
            *fields, *_displacements(fields, ctx.displacements), screen.table, screen.records, screen.tile_counts, sums,
            *outputs, v_screen, len(fields[0]),
            TERMS=fields[4].shape[1], ANTIALIAS=view.settings.antialias, **_effects(view, ctx.displacements),
        )  # fmt: skip
        return *outputs, v_screen, None, None


def _blend(screen: Screen, view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colours, transmittance, sum of depths; and per tile the index after the last pair that was looked at."""
    lists, shape = screen.lists, (view.camera.height, view.camera.width)
    rgb = screen.records.new_empty(*shape, 3)
    transmittance, depth_sum = screen.records.new_empty(shape), screen.records.new_empty(shape)
    lasts = lists.begins.new_empty(len(lists.begins))
    launch(
        blend.blend_tiles, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.begins, lists.ends, lists.order,
        rgb, transmittance, depth_sum, lasts, *_pixel_arguments(view),
        EXCLUSIVE=view.exclusive, DEPTH=True, options=ONE_WARP,
    )  # fmt: skip
    return rgb, transmittance, depth_sum, lasts


def _project(fields: tuple[Tensor, ...], displacements: Tensor | None, view: View) -> Screen:
    """Records of the visible rows and the tiles' lists; raises ValueError for bad values, PairLimitError."""
    means, sh = fields[0], fields[4]
    n, settings, table = len(means), view.settings, view.table(means.device)
    splats, radii = means.new_empty(n, records.LENGTH), means.new_empty(n)
    tile_counts = means.new_empty(n, dtype=torch.int32)
    bad = means.new_empty(-(-n // rows.block_of(view)), dtype=torch.int32)
    launch(
        rows.project_rows, n, rows.block_of(view),
        *fields, *_displacements(fields, displacements), table, splats, tile_counts, radii, bad, n,
        TERMS=sh.shape[1], ANTIALIAS=settings.antialias, HALF_COLORS=settings.half_colors, BOUNDED=view.bounded,
        **_effects(view, displacements), options={"enable_fp_fusion": False},
    )  # fmt: skip
    places = (tile_counts > 0).cumsum(0, dtype=torch.int32)
    numbers = torch.stack((tile_counts.sum(dtype=torch.int64), places[-1:].sum(), bad.sum()))
    pairs, visible, bad_blocks = numbers.tolist()
    if bad_blocks:
        check_values(Gaussians(*fields, displacements))
    check_pairs(pairs, tile_counts)
    return Screen(table, splats, tile_counts, radii, list_tiles(splats, tile_counts, places, visible, pairs, view))


def _sum_slots(values: Tensor, lists: Lists, sums: Tensor, padded: int, kind: tl.dtype) -> None:
    launch(
        slots.sum_slots, len(lists.rows), slots.ROWS,
        values, lists.rows, lists.first_pairs, lists.tile_counts, sums, len(lists.rows),
        COUNT=values.shape[1], PADDED=padded, SUM=kind,
    )  # fmt: skip


def _displacements(fields: tuple[Tensor, ...] | list[Tensor], displacements: Tensor | None) -> tuple[Tensor]:
    """The displacements, or anything in their place: nothing reads it then."""
    return (fields[0] if displacements is None else displacements,)


def _effects(view: View, displacements: Tensor | None) -> dict[str, bool]:
    return {"DISTORTED": view.distorted, "ROLLING": view.rolling, "DISPLACED": displacements is not None}


def _pixel_arguments(view: View) -> tuple[int, int, int, float, float]:
    camera, settings = view.camera, view.settings
    return camera.width, camera.height, view.tiles[0], settings.alpha_max, settings.transmittance_min


def _check(gaussians: Gaussians) -> None:
    means = gaussians.means
    if means.dtype != torch.float32:
        raise ValueError(
            f"backend 'triton' computes in float32, got {means.dtype}: convert the Gaussians with dataclasses.replace "
            "and .float(), or use backend='reference'"
        )
    if means.device.type != "cuda" and not is_interpreted(blend.blend_tiles):
        raise ValueError(
            f"backend 'triton' needs tensors on a CUDA device, got {means.device}: move them, use backend='cpu', or "
            "set TRITON_INTERPRET=1 before Python starts to run the kernels slowly on the CPU"
        )
