"""The Triton backend as an autograd function over torch tensors.

A forward pass waits for the device once, for the numbers of visible rows, pairs and bad values, when all is queued. A
backward pass never waits.
"""

from dataclasses import replace

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.raster import SHAPE, LeaveOneOutSums, empty_gradients
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton import blend
from sparsestreet.ops.triton.blend import MAX_ROWS
from sparsestreet.ops.triton.counters import (
    CHANGE_COUNT,
    COUNTER_COUNT,
    GATHERED_COUNT,
    count_tiles_pixels,
    remove_from_tiles,
)
from sparsestreet.ops.triton.gradients import GATE_PLACE, OPTIONS, ROWS, block_of, project_rows_backward, sum_slots
from sparsestreet.ops.triton.launch import is_interpreted, launch
from sparsestreet.ops.triton.lists import Lists
from sparsestreet.ops.triton.pixels import (
    ONE_WARP,
    Ends,
    blend_view,
    decompose,
    differentiate_view,
    pixel_arguments,
)
from sparsestreet.ops.triton.screen import Screen, contiguous, draw, effects, fields_of, given_or, parts_of, project
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Camera, Contribution, Gaussians, LeaveOneOut, Rendering


def render(
    gaussians: Gaussians,
    screen_offsets: Float[Tensor, "n 2"],
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None,
    camera: Camera,
    settings: SplatSettings,
    gates: Float[Tensor, " n"] | None = None,
    changes: LeaveOneOutSums | None = None,
) -> Rendering:
    """Projects, sorts by tile, blends and composes, in float32. Bitwise the same in every run on one device."""
    _check(gaussians)
    fields = gaussians.learned()
    learned = fields if gates is None else (*fields, gates)
    differentiated = torch.is_grad_enabled() and any(field.requires_grad for field in (*learned, screen_offsets))
    view, moved = KernelView.of(camera, settings), gaussians.displacements
    given = (screen_offsets, gates, background, moved, view, differentiated, changes, gaussians.terms)
    images = _Blend.apply(*given, *fields)
    return Rendering(*images, screen_offsets)


@torch.no_grad()
def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    _check(gaussians)
    view = KernelView.of(camera, settings)
    screen = project(gaussians, view)
    lists = screen.lists
    counters = screen.records.new_empty(len(lists.slots), COUNTER_COUNT)
    launch(
        count_tiles_pixels, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, lists.order, counters,
        *pixel_arguments(view), view.transmittance_min, EXCLUSIVE=view.exclusive, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(len(gaussians), COUNTER_COUNT, dtype=torch.float64, device=counters.device)
    _sum_slots(counters, lists, totals, 4, tl.float64)
    weight, pixels, dominant = totals.unbind(-1)
    return Contribution(weight, pixels.long(), dominant.long())


@torch.no_grad()
def leave_one_out(
    gaussians: Gaussians,
    background: Float[Tensor, "h w 3"] | None,
    pixel_weights: Float[Tensor, "h w"] | None,
    camera: Camera,
    settings: SplatSettings,
) -> LeaveOneOut:
    """How much the view changes when each row alone is removed, over a background (None: black)."""
    _check(gaussians)
    view = KernelView.of(camera, settings)
    screen = project(gaussians, view)
    ends = blend_view(screen, view, lasts=True).ends
    found = _remove(screen, view, ends, len(gaussians), background, pixel_weights)
    return replace(found, squared_change=found.squared_change[:, 0])


def _remove(
    screen: Screen, view: KernelView, ends: Ends, rows: int, background: Tensor | None, pixel_weights: Tensor | None
) -> LeaveOneOut:
    """Squared changes in one way, or in three by as many layers of weights."""
    three, lists, passed = pixel_weights is not None and pixel_weights.dim() == 3, screen.lists, ends.transmittance
    pairs = lists.sizes.pairs  # the tables may have room for more
    changes = passed.new_empty(pairs, GATHERED_COUNT if three else CHANGE_COUNT)
    behind, counts = contiguous(background), contiguous(pixel_weights)
    launch(
        remove_from_tiles, len(lists.order), 1,
        screen.records, lists.pair_rows, lists.slots, lists.begins, lists.ends, ends.lasts, lists.order,
        passed, given_or(behind, passed), given_or(counts, passed), changes, *pixel_arguments(view),
        BEHIND=behind is not None, WEIGHTED=counts is not None, THREE_WAYS=three, options=ONE_WARP,
    )  # fmt: skip
    totals = torch.zeros(rows, changes.shape[1], dtype=torch.float64, device=changes.device)
    _sum_slots(changes, lists, totals, 8 if three else 4, tl.float64)
    # A maximum is the same in any order.
    largest = torch.zeros_like(totals[:, 0])
    of_pairs = changes[lists.slots[:pairs], 0].double()
    largest.scatter_reduce_(0, lists.rows_of_pairs[:pairs].long(), of_pairs, "amax")
    return LeaveOneOut(largest, totals[:, 2:], totals[:, 1])


_GIVEN = 8
"""Number of the arguments before the fields."""


class _Blend(torch.autograd.Function):
    """Maps four fields, the tables of harmonics, the screen offsets, gates and the background to the images of a
    Rendering, and the radii."""

    @staticmethod
    def forward(
        ctx, screen_offsets, gates, background, displacements, view, differentiated, changes, terms, *fields
    ):  # fmt: skip
        ctx.set_materialize_grads(False)
        gaussians = Gaussians.of_learned(fields, terms, displacements)
        background = contiguous(background)
        screen, drawn = draw(
            gaussians, view, lambda screen: blend_view(screen, view, differentiated, background), gates
        )  # fmt: skip
        ctx.mark_non_differentiable(screen.radii)
        ctx.save_for_backward(*fields_of(gaussians), drawn.ends.transmittance, drawn.depth, background)
        ctx.screen, ctx.view, ctx.displacements, ctx.terms = screen, view, contiguous(displacements), terms
        ctx.lasts, ctx.parts, ctx.changes = drawn.ends.lasts, drawn.ends.parts, changes
        return drawn.rgb, drawn.alpha, drawn.depth, screen.radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb, v_alpha, v_depth, _v_radii):
        *fields, transmittance, depth, background = ctx.saved_tensors
        screen, view, lists = ctx.screen, ctx.view, ctx.screen.lists
        v_rgb = transmittance.new_zeros(*transmittance.shape, 3) if v_rgb is None else v_rgb.contiguous()
        v_passed, v_depth_sum, v_background = decompose(
            transmittance, depth, background, v_rgb, contiguous(v_alpha), contiguous(v_depth), ctx.needs_input_grad[2]
        )
        asked = ctx.needs_input_grad[_GIVEN:]
        if not any((*ctx.needs_input_grad[:2], *asked)):
            return None, None, v_background, *[None] * (_GIVEN - 3 + len(asked))
        ends, plain = Ends(transmittance, ctx.lasts, ctx.parts), view.settings.plain_gradients
        if (changes := ctx.changes) is not None:
            # A loop of its own over the same lists: in the one below it would take the registers of gradients.
            changes.found = _remove(screen, view, ends, len(fields[0]), changes.background, changes.pixel_weights)
        absolute = ctx.needs_input_grad[0] and not plain
        gradients = differentiate_view(screen, view, ends, v_rgb, v_passed, v_depth_sum, absolute)
        sums = transmittance.new_empty(len(fields[0]), gradients.shape[1])
        _sum_slots(gradients, lists, sums, 16, tl.float32)
        outputs, v_screen = empty_gradients(fields, ctx.terms, asked), transmittance.new_empty(len(fields[0]), 2)
        for part in parts_of(fields, ctx.terms):
            v_first, v_rest = (outputs[SHAPE + place] for place in part.places)
            launch(
                project_rows_backward, part.end - part.start, block_of(view),
                *fields[:SHAPE], part.first, part.rest, given_or(ctx.displacements, fields[0]), screen.table,
                screen.records, screen.tile_counts, sums, *outputs[:SHAPE], v_first, given_or(v_rest, v_first),
                v_screen, part.start, part.end,
                SUMS=sums.shape[1], TERMS=part.terms, STORED=part.stored, REST=v_rest is not None,
                ANTIALIAS=view.settings.antialias, CLAMPED=view.settings.clamp_colors,
                DETACHED=view.settings.detach_directions, PLAIN=plain, **effects(view, ctx.displacements),
            )  # fmt: skip
        return v_screen, _of_gates(screen, sums), v_background, *[None] * (_GIVEN - 3), *outputs


def _of_gates(screen: Screen, sums: Float[Tensor, "n s"]) -> Float[Tensor, " n"] | None:
    """Gradients of the gates; 0 for rows that were not drawn, whose sums are not written."""
    if not screen.gated:
        return None
    return torch.where(screen.tile_counts > 0, sums[:, GATE_PLACE], 0.0)


def _sum_slots(values: Tensor, lists: Lists, sums: Tensor, padded: int, kind: tl.dtype) -> None:
    launch(
        sum_slots, lists.sizes.rows, ROWS,
        values, lists.rows, lists.row_ends, lists.tile_counts, sums, lists.sizes.rows,
        COUNT=values.shape[1], PADDED=padded, SUM=kind, options=OPTIONS,
    )  # fmt: skip


def _check(gaussians: Gaussians) -> None:
    means = gaussians.means
    if len(gaussians) > MAX_ROWS:
        raise ValueError(f"backend 'triton' takes at most 2^28 rows, got {len(gaussians)}: render a part of them")
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
