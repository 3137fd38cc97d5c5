"""Rotation, scales and the conic of a row, forward and backward; everything before and after the lens."""

import math

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.vectors import dot, product, transposed
from sparsestreet.ops.triton.view import ALPHA_MIN, BLUR, BOX_REACH, LOG2_ALPHA_MIN

# alpha = 2^(log2 opacity - |L d|^2) with L the Cholesky factor of the conic times sqrt(log2(e) / 2).
LOG2_SCALE = constant(math.sqrt(math.log2(math.e) / 2))
TWO_LN2 = constant(2 * math.log(2))
HALF_LOG2_E = constant(math.log2(math.e) / 2)
# Of geometry/quaternions.py, in float32: the length below which gradients stop growing.
SHORTEST = constant(2.0**-126 / 2.0**-23)
# Of ops/reference: COMPENSATION_FLOOR squared, and DETERMINANT_MIN.
RATIO_FLOOR = constant(2.5e-5)
DETERMINANT_MIN = constant(1e-12)
LARGEST = constant(3.4028234663852886e38)


@jit
def unit_quaternion(q):
    """Unit quaternion and 1 / length; an exact zero is the identity with 1 / length 0.

    By the largest component first: squares would leave float32's range long before the length does. 1 / length stays
    below 1 / SHORTEST, where it would leave it.
    """
    largest = tl.maximum(tl.maximum(tl.abs(q[0]), tl.abs(q[1])), tl.maximum(tl.abs(q[2]), tl.abs(q[3])))
    scale = 1.0 / tl.maximum(largest, SHORTEST)
    w, x, y, z = q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale
    squared = w * w + x * x + y * y + z * z
    usable = squared > 0
    inverse = tl.where(usable, 1.0 / tl.sqrt(tl.where(usable, squared, 1.0)), 0.0)
    unit = (tl.where(usable, w * inverse, 1.0), x * inverse, y * inverse, z * inverse)
    return unit, tl.minimum(scale * inverse, 1.0 / SHORTEST)


@jit
def rotation_of(q):
    """world_from_gaussian of a unit quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


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
    a, b, c = v[0], v[1], v[2]
    w, x, y, z = q[0], q[1], q[2], q[3]
    gw = 2 * (x * (c[1] - b[2]) + y * (a[2] - c[0]) + z * (b[0] - a[1]))
    gx = 2 * (w * (c[1] - b[2]) + y * (a[1] + b[0]) + z * (a[2] + c[0])) - 4 * x * (b[1] + c[2])
    gy = 2 * (w * (a[2] - c[0]) + x * (a[1] + b[0]) + z * (b[2] + c[1])) - 4 * y * (a[0] + c[2])
    gz = 2 * (w * (b[0] - a[1]) + x * (a[2] + c[0]) + y * (b[2] + c[1])) - 4 * z * (a[0] + b[1])
    along = gw * w + gx * x + gy * y + gz * z
    k = inverse_length
    return ((gw - along * w) * k, (gx - along * x) * k, (gy - along * y) * k, (gz - along * z) * k), v_scales


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
