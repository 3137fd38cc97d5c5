"""Projects the rows of a scene to splats on the screen: one lane per row, every input read once."""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.columns import load_columns, store_columns
from sparsestreet.ops.triton.harmonics import basis, direction_of, raw_color
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.lens import pinhole
from sparsestreet.ops.triton.quaternions import unit_quaternion
from sparsestreet.ops.triton.shape import (
    DETERMINANT_MIN,
    LARGEST,
    LEAST_OPACITY,
    LOG2_SCALE,
    blurred,
    camera_axes,
    compensation,
    conic,
    cutoff_of,
    reach_of,
)
from sparsestreet.ops.triton.shutter import ROLL_LEAST, roll, velocity
from sparsestreet.ops.triton.tiles import BOX_MARGIN, count_tiles
from sparsestreet.ops.triton.unscented import unscented, within_fold
from sparsestreet.ops.triton.vectors import dot, load_row, times
from sparsestreet.ops.triton.view import (
    ALPHA_MIN,
    NEAR,
    ROTATION,
    SIZE,
    KernelView,
    in_camera,
    load_matrix,
)

HALF_LARGEST = constant(65504.0)


def block_of(view: KernelView) -> int:
    """Rows of a program: fewer if a lane holds the eight points of a distorted row."""
    return 32 if view.distorted else 128


@jit
def all_finite(values, COUNT: tl.constexpr):
    finite = tl.abs(values[0]) <= LARGEST
    for i in tl.static_range(1, COUNT):
        finite = finite & (tl.abs(values[i]) <= LARGEST)
    return finite


@jit
def on_screen(
    view, mean, axes, displacement, DISTORTED: tl.constexpr, ROLLING: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Shape on the screen (lens.py) of rows in front of the camera, and whether the lens and the shutter see them."""
    rotation = load_matrix(view + ROTATION)
    sees = mean[2] > 0
    if DISTORTED:
        sees = within_fold(view, mean)
        shape = unscented(view, mean, axes)
    else:
        shape = pinhole(view, mean, axes)
    if ROLLING:
        speed = velocity(view, mean, times(rotation, displacement), DISTORTED)
        shape, slowness = roll(view, shape, speed, COLUMNS)
        sees = sees & (slowness >= ROLL_LEAST)
    return shape, sees


@jit
def checked_row(means, quaternions, scales, opacities, displacements, row, given, DISPLACED: tl.constexpr):
    """Opacity, mean, quaternion, scales and displacement; which rows may be drawn, and which of those are bad.

    A row of opacity 0 is not read beyond its opacity.
    """
    opacity = tl.load(opacities + row, given, 0.0)
    alive = given & (opacity != 0)
    mean, q = load_row(means, row, alive, 3), load_row(quaternions, row, alive, 4)
    size, moved = load_row(scales, row, alive, 3), load_row(displacements, row, alive & DISPLACED, 3)
    good = all_finite(mean, 3) & all_finite(q, 4) & all_finite(size, 3) & all_finite(moved, 3)
    good = good & (size[0] >= 0) & (size[1] >= 0) & (size[2] >= 0) & (opacity >= 0) & (opacity <= 1)
    return opacity, mean, q, size, moved, alive, alive & (good == 0)


@jit
def half_box(view, effective, variance_x, variance_y, BOUNDED: tl.constexpr):
    """Half sides of the box around the ellipse where a splat ends; infinite if nothing bounds it."""
    half_x, half_y = 0 * effective + float("inf"), 0 * effective + float("inf")
    if BOUNDED:
        reach = reach_of(view, effective)
        half_x, half_y = tl.sqrt(reach * variance_x), tl.sqrt(reach * variance_y)
    return half_x, half_y


@jit
def seen_color(sh, row, seen, direction, TERMS: tl.constexpr, CLAMPED: tl.constexpr, HALF_COLORS: tl.constexpr):
    """Colors of the rows that are seen, and which of these have finite coefficients; other rows are not read."""
    coefficients, color = load_columns(sh, row, seen, 3 * TERMS), ()
    raw = raw_color(basis(direction, TERMS), coefficients, TERMS)
    for i in tl.static_range(3):
        # As in torch.where(color > 0, color, 0).
        channel = tl.where(raw[i] > 0, raw[i], 0.0)
        if CLAMPED:
            channel = tl.minimum(channel, 1.0)
        if HALF_COLORS:
            channel = tl.minimum(channel, HALF_LARGEST).to(tl.float16).to(tl.float32)
        color += (channel,)
    return color, all_finite(coefficients, 3 * TERMS)


@partial(jit, do_not_specialize=["rows"])
def project_rows(
    means, quaternions, scales, opacities, sh, displacements, view, records, tile_counts, radii, numbers, rows,
    TERMS: tl.constexpr, ANTIALIAS: tl.constexpr, CLAMPED: tl.constexpr, HALF_COLORS: tl.constexpr,
    BOUNDED: tl.constexpr, DISTORTED: tl.constexpr, ROLLING: tl.constexpr, COLUMNS: tl.constexpr,
    DISPLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the record of each visible row, and for all rows the number of tiles (0: culled) and the radius.

    ``numbers`` [3 programs]: each program's count of pairs, then of rows with tiles, then of bad rows. Comparisons are
    written so that NaN culls.
    """
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
    opacity, mean, q, size, moved, alive, wrong = checked_row(
        means, quaternions, scales, opacities, displacements, row, given, DISPLACED
    )
    rotation = load_matrix(view + ROTATION)
    mean = in_camera(view, rotation, mean)
    seen = alive & (mean[2] > tl.load(view + NEAR))
    # Lanes of rows that are not drawn compute with a harmless row.
    mean = (tl.where(seen, mean[0], 0.0), tl.where(seen, mean[1], 0.0), tl.where(seen, mean[2], 1.0))
    unit, _ = unit_quaternion(q)
    shape, sees = on_screen(view, mean, camera_axes(rotation, unit, size), moved, DISTORTED, ROLLING, COLUMNS)
    variance_x, variance_y, determinant = blurred(view, shape[2], shape[3], shape[5])
    seen = seen & sees & (determinant >= DETERMINANT_MIN) & (determinant <= LARGEST) & (dot(mean, mean) <= LARGEST)
    effective = opacity * compensation(shape[5], determinant, ANTIALIAS)
    seen = seen & (effective >= tl.load(view + ALPHA_MIN)) & (effective >= LEAST_OPACITY)

    x, y = shape[0], shape[1]
    half_x, half_y = half_box(view, effective, variance_x, variance_y, BOUNDED)
    width, height = tl.load(view + SIZE), tl.load(view + SIZE + 1)
    seen = seen & (x + (half_x + BOX_MARGIN) >= 0.5) & (x - (half_x + BOX_MARGIN) <= width - 0.5)
    seen = seen & (y + (half_y + BOX_MARGIN) >= 0.5) & (y - (half_y + BOX_MARGIN) <= height - 0.5)
    tl.store(radii + row, tl.where(seen, tl.maximum(half_x, half_y), 0.0), given)

    l11, l21, l22 = conic(variance_y, shape[4], determinant)
    l11, l21, l22 = LOG2_SCALE * l11, LOG2_SCALE * l21, LOG2_SCALE * l22
    log2_opacity = tl.log2(effective)
    cutoff = cutoff_of(view, log2_opacity)
    reach = tl.maximum(log2_opacity - cutoff, 0.0)
    tiles = count_tiles(x, y, l11, l21, l22, reach, seen, width, height, BOUNDED)
    tl.store(tile_counts + row, tiles, given)

    color, good = seen_color(sh, row, seen, direction_of(rotation, mean)[0], TERMS, CLAMPED, HALF_COLORS)
    # In the order of records.py.
    values = (x, y, l11, l21, l22, log2_opacity, cutoff, color[0], color[1], color[2], mean[2], 0 * x)
    store_columns(records, row, values, seen & (tiles > 0), record.RECORD)
    pairs, drawn = tl.sum(tl.where(given, tiles, 0)), tl.sum((given & (tiles > 0)).to(tl.int32))
    bad = tl.sum((wrong | (good == 0)).to(tl.int32))
    place = tl.arange(0, 4)
    number = tl.where(place == 0, pairs, tl.where(place == 1, drawn, bad))
    tl.store(numbers + place * tl.num_programs(0) + tl.program_id(0), number.to(tl.int64), place < 3)
