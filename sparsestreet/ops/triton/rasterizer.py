"""The Triton backend as an autograd function over torch tensors.

A forward pass waits for the device once, for the numbers of visible rows, pairs and bad values, when all is queued. A
backward pass never waits.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.raster import LeaveOneOutSums
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton import blend, graphs
from sparsestreet.ops.triton.blend import MAX_ROWS
from sparsestreet.ops.triton.launch import is_interpreted
from sparsestreet.ops.triton.passes import Asked, Cotangents, Inputs, counted, differentiate, removed
from sparsestreet.ops.triton.pixels import Ends, blend_view
from sparsestreet.ops.triton.screen import contiguous, draw, fields_of, project
from sparsestreet.ops.triton.view import DEPTH_PLACE, KernelView
from sparsestreet.types import Camera, Contribution, Gaussians, LeaveOneOut, MedianDepth, Rendering


def render(
    gaussians: Gaussians,
    screen_offsets: Float[Tensor, "n 2"],
    background: Float[Tensor, "3"] | Float[Tensor, "h w 3"] | None,
    camera: Camera,
    settings: SplatSettings,
    gates: Float[Tensor, " n"] | None = None,
    changes: LeaveOneOutSums | None = None,
    replay: bool = False,
) -> Rendering:
    """Projects, sorts by tile, blends and composes, in float32. Bitwise the same in every run on one device.

    ``replay``: as CUDA graphs, where there are neither gates nor changes."""
    _check(gaussians)
    fields = gaussians.learned()
    learned = fields if gates is None else (*fields, gates)
    differentiated = torch.is_grad_enabled() and any(field.requires_grad for field in (*learned, screen_offsets))
    view, moved = KernelView.of(camera, settings), contiguous(gaussians.displacements)
    replay = replay and gates is None and changes is None
    given = (screen_offsets, gates, background, moved, view, differentiated, changes, gaussians.terms, replay)
    images = _Blend.apply(*given, *fields)
    return Rendering(*images, screen_offsets)


@torch.no_grad()
def contribution(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Contribution:
    """Blend weights, touched pixels and dominated pixels per row of one view."""
    _check(gaussians)
    view = KernelView.of(camera, settings)
    weight, pixels, dominant = counted(project(gaussians, view), view, len(gaussians)).unbind(-1)
    return Contribution(weight, pixels.long(), dominant.long())


@torch.no_grad()
def median_depth(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> MedianDepth:
    """Which splat finished each pixel; ``settings`` stop inclusively at half of the light."""
    _check(gaussians)
    view = KernelView.of(camera, settings)
    screen = project(gaussians, view)
    drawn = blend_view(screen, view, lasts=True)
    lasts, met = drawn.ends.lasts, drawn.ends.transmittance <= view.transmittance_min
    assert lasts is not None  # as it was asked for
    rows, depth = torch.full_like(lasts, -1), torch.full_like(drawn.depth, torch.inf)
    rows[met] = screen.lists.pair_rows[lasts[met].long() - 1] & (MAX_ROWS - 1)
    depth[met] = screen.records[rows[met].long(), DEPTH_PLACE]
    return MedianDepth(depth, rows.long(), drawn.alpha)


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
    return removed(screen, view, ends, len(gaussians), background, pixel_weights)


_GIVEN = 9
"""Number of the arguments before the fields."""


class _Blend(torch.autograd.Function):
    """Maps four fields, the tables of harmonics, the screen offsets, gates and the background to the images of a
    Rendering, and the radii."""

    @staticmethod
    def forward(
        ctx, screen_offsets, gates, background, displacements, view, differentiated, changes, terms, replay, *fields
    ):  # fmt: skip
        ctx.set_materialize_grads(False)
        gaussians, background = Gaussians.of_learned(fields, terms, displacements), contiguous(background)
        fields = fields_of(gaussians)
        ctx.view, ctx.displacements, ctx.terms, ctx.lease = view, displacements, terms, None
        if replay:
            replayed = graphs.drawn(Inputs(fields, terms, displacements, background, view), differentiated)
            if replayed is not None:
                ctx.lease, images = replayed
                ctx.mark_non_differentiable(images.radii)
                ctx.save_for_backward(*fields, background)
                return tuple(images)
        screen, drawn = draw(
            gaussians, view, lambda screen: blend_view(screen, view, differentiated, background), gates
        )  # fmt: skip
        ctx.mark_non_differentiable(screen.radii)
        ctx.save_for_backward(*fields, background, drawn.ends.transmittance, drawn.depth)
        ctx.screen, ctx.lasts, ctx.parts, ctx.changes = screen, drawn.ends.lasts, drawn.ends.parts, changes
        return drawn.rgb, drawn.alpha, drawn.depth, screen.radii

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb, v_alpha, v_depth, _v_radii):
        needs = ctx.needs_input_grad
        asked, cotangents = Asked(*needs[:3], needs[_GIVEN:]), Cotangents(v_rgb, v_alpha, v_depth)
        if ctx.lease is not None:
            *fields, background = ctx.saved_tensors
            inputs = Inputs(tuple(fields), ctx.terms, ctx.displacements, background, ctx.view)
            found = ctx.lease.differentiate(inputs, cotangents, asked)
        else:
            *fields, background, transmittance, depth = ctx.saved_tensors
            inputs = Inputs(tuple(fields), ctx.terms, ctx.displacements, background, ctx.view)
            ends = Ends(transmittance, ctx.lasts, ctx.parts)
            found = differentiate(inputs, ctx.screen, ends, depth, cotangents, asked, ctx.changes)
        return found.screen, found.gates, found.background, *[None] * (_GIVEN - 3), *found.fields


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
