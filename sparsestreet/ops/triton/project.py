"""Rotation, scales and the conic of a row, forward and backward; everything before and after the lens."""

import math
from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import view as record
from sparsestreet.ops.triton.cameras import ROLL_LEAST, pinhole, roll, unscented, velocity, within_fold
from sparsestreet.ops.triton.launch import constant, jit
from sparsestreet.ops.triton.quaternions import (
    dot,
    load_row,
    plus,
    product,
    rotation_backward,
    rotation_of,
    scaled,
    times,
    transposed,
    transposed_times,
    unit_backward,
    unit_quaternion,
)
from sparsestreet.ops.triton.view import (
    ALPHA_MIN,
    BLUR,
    BOX_MARGIN,
    BOX_REACH,
    LOG2_ALPHA_MIN,
    NEAR,
    ROTATION,
    SIZE,
    KernelView,
    count_tiles,
    in_camera,
    load_columns,
    load_harmonics,
    load_matrix,
    store_columns,
)

# alpha = 2^(log2 opacity - |L d|^2) with L the Cholesky factor of the conic times sqrt(log2(e) / 2).
LOG2_SCALE = constant(math.sqrt(math.log2(math.e) / 2))
TWO_LN2 = constant(2 * math.log(2))
HALF_LOG2_E = constant(math.log2(math.e) / 2)
# Of ops/reference: COMPENSATION_FLOOR squared, MIN_OPACITY and DETERMINANT_MIN.
RATIO_FLOOR = constant(2.5e-5)
MIN_OPACITY = constant(2.0**-126)
DETERMINANT_MIN = constant(1e-12)
LARGEST = constant(3.4028234663852886e38)


@jit
def times_columns(m, s):
    """m diag(s)."""
    a, b, c = m[0], m[1], m[2]
    return (
        (a[0] * s[0], a[1] * s[1], a[2] * s[2]),
        (b[0] * s[0], b[1] * s[1], b[2] * s[2]),
        (c[0] * s[0], c[1] * s[1], c[2] * s[2]),
    )


@jit
def camera_axes(rotation, q, scales):
    """Columns: the Gaussian's axes in the camera, one standard deviation long; ``q`` is a unit quaternion."""
    return product(rotation, times_columns(rotation_of(q), scales))


@jit
def axes_backward(rotation, q, inverse_length, scales, v_axes):
    """From the gradient of camera_axes to those of the given quaternion and of the scales."""
    v = product(transposed(rotation), v_axes)
    r, columns = transposed(rotation_of(q)), transposed(v)
    v_scales = (dot(columns[0], r[0]), dot(columns[1], r[1]), dot(columns[2], r[2]))
    v = times_columns(v, scales)
    return unit_backward(q, inverse_length, rotation_backward(q, v)), v_scales


@jit
def blurred(view, xx, yy, bare):
    """Variances and determinant after the low-pass."""
    blur = tl.load(view + BLUR)
    return xx + blur, yy + blur, bare + blur * (xx + yy) + blur * blur


@jit
def compensation(bare, determinant, ANTIALIAS: tl.constexpr):
    if ANTIALIAS:
        ratio = bare / determinant
        factor = tl.sqrt(tl.where(ratio > RATIO_FLOOR, ratio, RATIO_FLOOR))
    else:
        factor = 0 * bare + 1.0
    return factor


@jit
def conic(variance_y, covariance, determinant):
    """Cholesky factor (l11, l21, l22) of the inverse covariance, 1/px."""
    root = tl.sqrt(variance_y)
    return tl.sqrt(variance_y / determinant), -covariance / (root * tl.sqrt(determinant)), 1.0 / root


@jit
def conic_backward(view, shape, v_l, v_opacity, opacity, ANTIALIAS: tl.constexpr):
    """From the gradients of the conic and of the effective opacity to those of (xx, yy, xy, bare)."""
    blur = tl.load(view + BLUR)
    _, variance_y, determinant = blurred(view, shape[2], shape[3], shape[5])
    l11, l21, l22 = conic(variance_y, shape[4], determinant)
    v_variance = (v_l[0] * l11 - v_l[1] * l21 - v_l[2] * l22) / (2 * variance_y)
    v_covariance = -v_l[1] / (tl.sqrt(variance_y) * tl.sqrt(determinant))
    v_bare = -(v_l[0] * l11 + v_l[1] * l21) / (2 * determinant)
    v_trace = v_bare * blur
    if ANTIALIAS:
        ratio = shape[5] / determinant
        live = ratio > RATIO_FLOOR
        v_ratio = tl.where(live, v_opacity * opacity / (2 * tl.sqrt(tl.where(live, ratio, 1.0))), 0.0)
        v_bare += v_ratio * (1 - ratio) / determinant
        v_trace -= v_ratio * ratio * blur / determinant
    return v_trace, v_trace + v_variance, v_covariance, v_bare


@jit
def reach_of(view, opacity):
    """|L d|^2 (natural units: alpha = opacity exp(-|L d|^2 / 2)) up to which a splat is drawn."""
    reach = 2 * tl.log(opacity / tl.load(view + ALPHA_MIN))
    return tl.minimum(tl.maximum(reach, 0.0), tl.load(view + BOX_REACH))


@jit
def cutoff_of(view, log2_opacity):
    """The exponent of 2 below which a splat is not drawn: alpha_min, or where its box ends."""
    return tl.maximum(tl.load(view + LOG2_ALPHA_MIN), log2_opacity - HALF_LOG2_E * tl.load(view + BOX_REACH))


Y0 = constant(0.5 / math.sqrt(math.pi))
Y1 = constant(math.sqrt(3 / (4 * math.pi)))
Y2_MIXED, Y2_ZONAL, Y2_PLANAR = (constant(math.sqrt(n / math.pi) / d) for n, d in ((15, 2), (5, 4), (15, 4)))
Y3_OUTER, Y3_CORNER, Y3_MIDDLE, Y3_ZONAL, Y3_PLANAR = (
    constant(math.sqrt(n / math.pi) / d) for n, d in ((17.5, 4), (105, 2), (10.5, 4), (7, 4), (105, 4))
)


@jit
def basis(d, TERMS: tl.constexpr):
    """The first TERMS functions at the unit direction d."""
    x, y, z = d[0], d[1], d[2]
    values = (0 * x + Y0,)
    if TERMS > 1:
        values += (-Y1 * y, Y1 * z, -Y1 * x)
    if TERMS > 4:
        values += (
            Y2_MIXED * x * y,
            -Y2_MIXED * y * z,
            Y2_ZONAL * (2 * z * z - x * x - y * y),
            -Y2_MIXED * x * z,
            Y2_PLANAR * (x * x - y * y),
        )
    if TERMS > 9:
        values += (
            -Y3_OUTER * y * (3 * x * x - y * y),
            Y3_CORNER * x * y * z,
            -Y3_MIDDLE * y * (4 * z * z - x * x - y * y),
            Y3_ZONAL * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -Y3_MIDDLE * x * (4 * z * z - x * x - y * y),
            Y3_PLANAR * z * (x * x - y * y),
            -Y3_OUTER * x * (x * x - 3 * y * y),
        )
    return values


@jit
def basis_backward(d, v, TERMS: tl.constexpr):
    """sum_i v[i] d(basis_i)/d(direction)."""
    x, y, z = d[0], d[1], d[2]
    gx, gy, gz = 0 * x, 0 * x, 0 * x
    if TERMS > 1:
        gx, gy, gz = gx - Y1 * v[3], gy - Y1 * v[1], gz + Y1 * v[2]
    if TERMS > 4:
        xy, yz, xz = Y2_MIXED * v[4], Y2_MIXED * v[5], Y2_MIXED * v[7]
        zonal, planar = 2 * Y2_ZONAL * v[6], 2 * Y2_PLANAR * v[8]
        gx += xy * y - xz * z + (planar - zonal) * x
        gy += xy * x - yz * z - (planar + zonal) * y
        gz += 2 * zonal * z - yz * y - xz * x
    if TERMS > 9:
        left, corner, low = Y3_OUTER * v[9], Y3_CORNER * v[10], Y3_MIDDLE * v[11]
        zonal3, high, planar3, right = Y3_ZONAL * v[12], Y3_MIDDLE * v[13], Y3_PLANAR * v[14], Y3_OUTER * v[15]
        xx, yy, zz = x * x, y * y, z * z
        gx += y * (corner * z - 6 * left * x + 2 * low * x) - 6 * zonal3 * x * z - high * (4 * zz - 3 * xx - yy)
        gx += 2 * planar3 * x * z - 3 * right * (xx - yy)
        gy += x * (corner * z + 2 * high * y + 6 * right * y) - 3 * left * (xx - yy) - low * (4 * zz - xx - 3 * yy)
        gy -= 6 * zonal3 * y * z + 2 * planar3 * y * z
        gz += corner * x * y - 8 * low * y * z + 3 * zonal3 * (2 * zz - xx - yy) - 8 * high * x * z
        gz += planar3 * (xx - yy)
    return gx, gy, gz


@jit
def direction_of(rotation, mean):
    """Unit direction from the camera to ``mean`` (camera frame) in the world, and the distance."""
    ray = transposed_times(rotation, mean)
    distance = tl.sqrt(dot(ray, ray))
    return scaled(1.0 / distance, ray), distance


@jit
def raw_color(values, sh, TERMS: tl.constexpr):
    """0.5 + sum_i basis_i sh_i, before the clamp."""
    red, green, blue = 0 * values[0] + 0.5, 0 * values[0] + 0.5, 0 * values[0] + 0.5
    for i in tl.static_range(TERMS):
        red += values[i] * sh[3 * i]
        green += values[i] * sh[3 * i + 1]
        blue += values[i] * sh[3 * i + 2]
    return red, green, blue


@jit
def inside_unit(channel, v):
    """The gradient of torch's clamp to [0, 1], which counts both ends as inside."""
    return tl.where((channel >= 0) & (channel <= 1), v, 0.0)


@jit
def color_backward(rotation, mean, v, sh, TERMS: tl.constexpr, CLAMPED: tl.constexpr, DETACHED: tl.constexpr):
    """Gradients of the coefficients, and of ``mean`` through the direction (0 if DETACHED)."""
    direction, distance = direction_of(rotation, mean)
    values = basis(direction, TERMS)
    raw = raw_color(values, sh, TERMS)
    if CLAMPED:
        v = (inside_unit(raw[0], v[0]), inside_unit(raw[1], v[1]), inside_unit(raw[2], v[2]))
    else:
        v = (tl.where(raw[0] > 0, v[0], 0.0), tl.where(raw[1] > 0, v[1], 0.0), tl.where(raw[2] > 0, v[2], 0.0))
    v_sh, v_values = (), ()
    for i in tl.static_range(TERMS):
        v_sh += scaled(values[i], v)
        v_values += (dot((sh[3 * i], sh[3 * i + 1], sh[3 * i + 2]), v),)
    v_mean = (0 * distance, 0 * distance, 0 * distance)
    if not DETACHED:
        v_direction = basis_backward(direction, v_values, TERMS)
        across = plus(v_direction, scaled(-dot(v_direction, direction), direction))
        v_mean = times(rotation, scaled(1.0 / distance, across))
    return v_sh, v_mean


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
def coefficients_of(first, rest, row, start, seen, TERMS: tl.constexpr, STORED: tl.constexpr):
    """The harmonics of rows, of one table of all rows, or (STORED >= 0) of tables whose first row is ``start``."""
    if STORED >= 0:
        coefficients = load_harmonics(first, rest, row - start, seen, TERMS, STORED)
    else:
        coefficients = load_columns(first, row, seen, 3 * TERMS)
    return coefficients


@jit
def seen_color(coefficients, direction, TERMS: tl.constexpr, CLAMPED: tl.constexpr, HALF_COLORS: tl.constexpr):
    """Colors of rows, and which of these have finite coefficients."""
    color = ()
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


@partial(jit, do_not_specialize=["start", "end", "blocks"])
def project_rows(
    means, quaternions, scales, opacities, first, rest, displacements, view, records, tile_counts, radii, numbers,
    start, end, blocks, TERMS: tl.constexpr, STORED: tl.constexpr, ANTIALIAS: tl.constexpr, CLAMPED: tl.constexpr,
    HALF_COLORS: tl.constexpr, BOUNDED: tl.constexpr, DISTORTED: tl.constexpr, ROLLING: tl.constexpr,
    COLUMNS: tl.constexpr, DISPLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the record of each visible row, and for all rows the number of tiles (0: culled) and the radius.

    Rows are those from ``start`` to ``end`` of one table of harmonics. ``numbers`` [3 blocks of all rows]: each block's
    count of pairs, then of rows with tiles, then of bad rows. Comparisons are written so that NaN culls.
    """
    block = tl.program_id(0) + start // BLOCK
    row = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = (row >= start) & (row < end)
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
    seen = seen & (effective >= tl.load(view + ALPHA_MIN)) & (effective >= MIN_OPACITY)

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

    coefficients = coefficients_of(first, rest, row, start, seen, TERMS, STORED)
    color, good = seen_color(coefficients, direction_of(rotation, mean)[0], TERMS, CLAMPED, HALF_COLORS)
    # In the order of records.py.
    values = (x, y, l11, l21, l22, log2_opacity, cutoff, color[0], color[1], color[2], mean[2], 0 * x)
    store_columns(records, row, values, seen & (tiles > 0), record.RECORD)
    pairs, drawn = tl.sum(tl.where(given, tiles, 0)), tl.sum((given & (tiles > 0)).to(tl.int32))
    bad = tl.sum((wrong | (good == 0)).to(tl.int32))
    place = tl.arange(0, 4)
    number = tl.where(place == 0, pairs, tl.where(place == 1, drawn, bad))
    number, to = number.to(tl.int64), numbers + place * blocks + block
    if STORED >= 0:
        # The launch before this one has counted the rows of the block that are not its own.
        number += tl.load(to, (place < 3) & (block * BLOCK < start), 0)
    tl.store(to, number, place < 3)
