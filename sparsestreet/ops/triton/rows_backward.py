"""Turns the sums over pixels into gradients of the parameters: one lane per row, every gradient written once."""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.columns import load_columns, store_columns
from sparsestreet.ops.triton.harmonics import color_backward
from sparsestreet.ops.triton.language import jit
from sparsestreet.ops.triton.lens import pinhole, pinhole_backward
from sparsestreet.ops.triton.quaternions import unit_quaternion
from sparsestreet.ops.triton.shape import (
    LOG2_SCALE,
    TWO_LN2,
    axes_backward,
    blurred,
    camera_axes,
    compensation,
    conic_backward,
)
from sparsestreet.ops.triton.shutter import roll, roll_backward, velocity, velocity_backward
from sparsestreet.ops.triton.unscented import unscented, unscented_backward
from sparsestreet.ops.triton.vectors import load_row, plus, store_row, times, transposed_times
from sparsestreet.ops.triton.view import ROTATION, KernelView, in_camera, load_matrix


def block_of(view: KernelView) -> int:
    """Rows of a program. 16 distorted rows of eight points take as many lanes as 128 others, so none spills
    registers."""
    return 16 if view.distorted else 128


@jit
def lens_shape(view, mean, axes, DISTORTED: tl.constexpr):
    return unscented(view, mean, axes) if DISTORTED else pinhole(view, mean, axes)


@jit
def lens_backward(view, mean, axes, v, DISTORTED: tl.constexpr):
    return unscented_backward(view, mean, axes, v) if DISTORTED else pinhole_backward(view, mean, axes, v)


@jit
def screen_gradient(s, to, mask):
    """A row's sums over pixels (blend_backward.py) in natural units (exponent -|L d|^2 / 2).

    Returns the gradients of the mean, their absolute values, and those of (l11, l21, l22) and the effective opacity.
    """
    l11, l21 = tl.load(to + record.L11, mask, 1.0), tl.load(to + record.L21, mask, 0.0)
    l22, log2_opacity = tl.load(to + record.L22, mask, 1.0), tl.load(to + record.LOG2_OPACITY, mask, 0.0)
    v_mean = (TWO_LN2 * l11 * s[1], TWO_LN2 * (l21 * s[1] + l22 * s[2]))
    v_absolute = (TWO_LN2 * l11 * s[6], TWO_LN2 * s[7])
    k = -TWO_LN2 * LOG2_SCALE
    return v_mean, v_absolute, (k * s[3], k * s[4], k * s[5]), s[0] * tl.exp2(-log2_opacity)


@partial(jit, do_not_specialize=["rows"])
def project_rows_backward(
    means, quaternions, scales, opacities, sh, displacements, view, records, tile_counts, sums,
    v_means, v_quaternions, v_scales, v_opacities, v_sh, v_screen, rows,
    SUMS: tl.constexpr, TERMS: tl.constexpr, ANTIALIAS: tl.constexpr, CLAMPED: tl.constexpr, DETACHED: tl.constexpr,
    PLAIN: tl.constexpr, DISTORTED: tl.constexpr, ROLLING: tl.constexpr, COLUMNS: tl.constexpr,
    DISPLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of all rows; exactly 0 for rows that were not drawn, of which only the tile count is read.

    SUMS: how many numbers a row has in ``sums``, of which the first twelve are read."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
    seen = given & (tl.load(tile_counts + row, given, 0) > 0)
    rotation = load_matrix(view + ROTATION)
    mean = in_camera(view, rotation, load_row(means, row, seen, 3))
    # Lanes of rows that were not drawn compute with a harmless row.
    mean = (tl.where(seen, mean[0], 0.0), tl.where(seen, mean[1], 0.0), tl.where(seen, mean[2], 1.0))
    s = load_columns(sums, row, seen, SUMS)
    coefficients = load_columns(sh, row, seen, 3 * TERMS)
    # This comes first, so that nothing else holds registers meanwhile.
    v_colors = (s[8], s[9], s[10])
    v_coefficients, v_mean = color_backward(rotation, mean, v_colors, coefficients, TERMS, CLAMPED, DETACHED)
    store_columns(v_sh, row, v_coefficients, given, 3 * TERMS)

    size = load_row(scales, row, seen, 3)
    unit, inverse_length = unit_quaternion(load_columns(quaternions, row, seen, 4))
    axes = camera_axes(rotation, unit, size)
    lens = lens_shape(view, mean, axes, DISTORTED)
    shape = lens
    if ROLLING:
        moved = times(rotation, load_row(displacements, row, seen & DISPLACED, 3))
        speed = velocity(view, mean, moved, DISTORTED)
        shape, _ = roll(view, lens, speed, COLUMNS)

    to = record.record_of(records, row)
    v_screen_mean, v_absolute, v_l, v_effective = screen_gradient(s, to, seen)
    opacity = tl.load(opacities + row, seen, 0.0)
    _, _, determinant = blurred(view, shape[2], shape[3], shape[5])
    v_opacity = v_effective * compensation(shape[5], determinant, ANTIALIAS)
    v_xx, v_yy, v_xy, v_bare = conic_backward(view, shape, v_l, v_effective, opacity, ANTIALIAS)
    v_shape = (v_screen_mean[0], v_screen_mean[1], v_xx, v_yy, v_xy, v_bare)
    if ROLLING:
        v_shape, v_speed = roll_backward(view, lens, speed, v_shape, COLUMNS)
        v_mean = plus(v_mean, velocity_backward(view, mean, moved, v_speed, DISTORTED))
    through_lens, v_axes = lens_backward(view, mean, axes, v_shape, DISTORTED)
    v_quaternion, v_size = axes_backward(rotation, unit, inverse_length, size, v_axes)
    v_mean = plus(plus(v_mean, through_lens), (0.0, 0.0, s[11]))
    v_mean = transposed_times(rotation, v_mean)
    store_row(v_means, row, masked(v_mean, seen, 3), given, 3)
    store_columns(v_quaternions, row, masked(v_quaternion, seen, 4), given, 4)
    store_row(v_scales, row, masked(v_size, seen, 3), given, 3)
    store_row(v_screen, row, masked(v_screen_mean if PLAIN else v_absolute, seen, 2), given, 2)
    tl.store(v_opacities + row, tl.where(seen, v_opacity, 0.0), given)


@jit
def masked(values, mask, COUNT: tl.constexpr):
    """``values``, exactly 0 where the mask is off."""
    out = ()
    for i in tl.static_range(COUNT):
        out += (tl.where(mask, values[i], 0.0),)
    return out
