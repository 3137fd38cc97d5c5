"""Rotation, scales and the conic of a row, forward and backward; everything before and after the lens."""

import math

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.quaternions import rotation_backward, rotation_of, unit_backward
from sparsestreet.ops.triton.vectors import dot, product, transposed
from sparsestreet.ops.triton.view import ALPHA_MIN, BLUR, BOX_REACH, LOG2_ALPHA_MIN

# alpha = 2^(log2 opacity - |L d|^2) with L the Cholesky factor of the conic times sqrt(log2(e) / 2).
LOG2_SCALE = constant(math.sqrt(math.log2(math.e) / 2))
TWO_LN2 = constant(2 * math.log(2))
HALF_LOG2_E = constant(math.log2(math.e) / 2)
# Of ops/reference: COMPENSATION_FLOOR squared, LEAST_OPACITY and DETERMINANT_MIN.
RATIO_FLOOR = constant(2.5e-5)
LEAST_OPACITY = constant(2.0**-126)
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
