"""The sky behind an image and its gradients, one kernel each: ``sparsestreet.ops.over_sky``.

A lane is a pixel; pixels that see no sky load nothing of it. Backward adds to the texels' gradient by atomics. Pixels
that share a texel do so in any order, so two runs agree only up to rounding.
"""

import itertools

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.cameras import ray_directions, ray_matrix
from sparsestreet.ops.cube_map import bordered_texels
from sparsestreet.ops.triton.launch import constant, jit, launch
from sparsestreet.ops.triton.quaternions import times
from sparsestreet.types import Camera

LANES = 128
CHANNELS = constant(3)


def over_sky(
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    texels: Float[Tensor, "6 r r 3"],
    camera: Camera,
    transmittance_min: float,
) -> Float[Tensor, "h w 3"]:
    """``sparsestreet.ops.over_sky`` of contiguous float32 tensors."""
    return _OverSky.apply(rgb, alpha, texels, camera, transmittance_min)


class _OverSky(torch.autograd.Function):
    """Adds the sky. Backward reads the texels again."""

    @staticmethod
    def forward(ctx, rgb, alpha, texels, camera, transmittance_min):
        # Without a lens no directions are read.
        directions = alpha if camera.distortion is None else ray_directions(camera, rgb.device).to(rgb)
        ctx.save_for_backward(alpha, texels, directions)
        ctx.camera, ctx.transmittance_min = camera, transmittance_min
        out = torch.empty_like(rgb)
        _launch(lay_over_sky, ctx, alpha, texels, directions, rgb, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, v_out):
        alpha, texels, directions = ctx.saved_tensors
        v_alpha, v_texels = torch.empty_like(alpha), torch.zeros_like(texels)
        _launch(lay_over_sky_backward, ctx, alpha, texels, directions, v_out.contiguous(), v_alpha, v_texels)
        return v_out, v_alpha, v_texels, None, None


def _launch(kernel, ctx, alpha: Tensor, texels: Tensor, directions: Tensor, *images: Tensor) -> None:
    side = texels.shape[1]
    launch(
        kernel, alpha.numel(), LANES,
        alpha, texels, bordered_texels(side, texels.device), directions, *images, ctx.transmittance_min,
        *itertools.chain(*ray_matrix(ctx.camera)), ctx.camera.width, alpha.numel(), side,
        LENS=ctx.camera.distortion is not None,
    )  # fmt: skip


@jit
def direction(directions, rays, pixel, seen, width, LENS: tl.constexpr):
    """Direction in the world, of any length."""
    if LENS:
        at = directions + pixel * CHANNELS
        return tl.load(at, seen, 1.0), tl.load(at + 1, seen, 1.0), tl.load(at + 2, seen, 1.0)
    return times(rays, (pixel % width + 0.5, pixel // width + 0.5, 1.0))


@jit
def bordered_place(from_middle, side):
    """Coordinate in the bordered face, whose texel centers are whole numbers.

    NaN becomes a coordinate inside too, so that nothing is read outside the table."""
    place, most = from_middle + (0.5 * side + 0.5), side + 0.5
    place = tl.where(place > 0.5, place, 0.5)
    return tl.where(place < most, place, most)


@jit
def corners(bordered, d, seen, side):
    """The first numbers of the four texels around a direction, and their bilinear weights."""
    x, y, z = tl.abs(d[0]), tl.abs(d[1]), tl.abs(d[2])
    along_x = (x >= y) & (x >= z)
    along_z = (z > x) & (z > y)
    largest = tl.where(along_x, d[0], tl.where(along_z, d[2], d[1]))
    face = tl.where(along_x, 0, tl.where(along_z, 4, 2)) + (largest < 0).to(tl.int32)
    scale = 0.5 * side / tl.abs(largest)
    across = bordered_place(tl.where(along_x, d[1], d[0]) * scale, side)
    down = bordered_place(tl.where(along_z, d[1], d[2]) * scale, side)
    left, top = across.to(tl.int32), down.to(tl.int32)
    right_share, bottom_share = across - left, down - top
    left_share, top_share = 1 - right_share, 1 - bottom_share
    first = bordered + (face * (side + 2) + top) * (side + 2) + left
    below = first + side + 2
    at = (tl.load(first, seen, 0) * CHANNELS, tl.load(first + 1, seen, 0) * CHANNELS,
          tl.load(below, seen, 0) * CHANNELS, tl.load(below + 1, seen, 0) * CHANNELS)  # fmt: skip
    weights = (left_share * top_share, right_share * top_share, left_share * bottom_share, right_share * bottom_share)
    return at, weights


@jit
def mix(texels, at, weights, seen, CHANNEL: tl.constexpr):
    """One channel of the mean color of the four texels."""
    total = weights[0] * tl.load(texels + at[0] + CHANNEL, seen, 0.0)
    for i in tl.static_range(1, 4):
        total += weights[i] * tl.load(texels + at[i] + CHANNEL, seen, 0.0)
    return total


@jit
def lay_over_sky(
    alpha, texels, bordered, directions, rgb, out, least_light,
    xx, xy, x1, yx, yy, y1, zx, zy, z1, width, pixels, side,
    LENS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``xx`` to ``z1``: the matrix from a place (x, y, 1) in the image to its direction."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    light = 1 - tl.load(alpha + pixel, inside, 1.0)
    seen = inside & (light > least_light)
    d = direction(directions, ((xx, xy, x1), (yx, yy, y1), (zx, zy, z1)), pixel, seen, width, LENS)
    at, weights = corners(bordered, d, seen, side)
    for channel in tl.static_range(CHANNELS):
        color = mix(texels, at, weights, seen, channel)
        before = tl.load(rgb + pixel * CHANNELS + channel, inside, 0.0)
        tl.store(out + pixel * CHANNELS + channel, before + tl.where(seen, light * color, 0.0), inside)


@jit
def lay_over_sky_backward(
    alpha, texels, bordered, directions, v_out, v_alpha, v_texels, least_light,
    xx, xy, x1, yx, yy, y1, zx, zy, z1, width, pixels, side,
    LENS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    light = 1 - tl.load(alpha + pixel, inside, 1.0)
    seen = inside & (light > least_light)
    d = direction(directions, ((xx, xy, x1), (yx, yy, y1), (zx, zy, z1)), pixel, seen, width, LENS)
    at, weights = corners(bordered, d, seen, side)
    v_light = tl.zeros_like(light)
    for channel in tl.static_range(CHANNELS):
        v = tl.load(v_out + pixel * CHANNELS + channel, seen, 0.0)
        v_light += v * mix(texels, at, weights, seen, channel)
        for i in tl.static_range(4):
            tl.atomic_add(v_texels + at[i] + channel, light * weights[i] * v, seen, sem="relaxed")
    tl.store(v_alpha + pixel, tl.where(seen, -v_light, 0.0), inside)
