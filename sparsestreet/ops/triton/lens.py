"""A Gaussian in the camera to its mean and second moments on the screen: the pinhole (EWA, Zwicker et al. 2001).

A shape on the screen is (x, y, xx, yy, xy, bare): mean and covariance V V^T in pixels with V = J R S, and
bare = det(V V^T) by Cauchy-Binet, a sum of squares, so that needles lose no digits.
"""

import triton.language as tl

from sparsestreet.ops.triton.language import jit
from sparsestreet.ops.triton.vectors import cross, dot, plus, scaled
from sparsestreet.ops.triton.view import CENTER, FOCAL, SLOPE_LEAST, SLOPE_MOST


@jit
def limited_slope(view, slope, AXIS: tl.constexpr):
    return tl.minimum(tl.maximum(slope, tl.load(view + SLOPE_LEAST + AXIS)), tl.load(view + SLOPE_MOST + AXIS))


@jit
def factor(view, mean, along, across, AXIS: tl.constexpr):
    """One row of V; ``along`` and ``across`` are the axis' own row and the depth's row of R S."""
    scale = tl.load(view + FOCAL + AXIS) / mean[2]
    slope = limited_slope(view, mean[AXIS] / mean[2], AXIS)
    return scaled(scale, plus(along, scaled(-slope, across)))


@jit
def pinhole(view, mean, axes):
    """Shape on the screen of a Gaussian at ``mean`` with ``axes`` = camera_from_gaussian times scales."""
    vx, vy = factor(view, mean, axes[0], axes[2], 0), factor(view, mean, axes[1], axes[2], 1)
    c = cross(vx, vy)
    x = tl.load(view + FOCAL) * mean[0] / mean[2] + tl.load(view + CENTER)
    y = tl.load(view + FOCAL + 1) * mean[1] / mean[2] + tl.load(view + CENTER + 1)
    return x, y, dot(vx, vx), dot(vy, vy), dot(vx, vy), dot(c, c)


@jit
def factor_backward(view, mean, along, across, v, AXIS: tl.constexpr):
    """From the gradient v of a row of V to those of the axis' row, of the depth's row, of mean[AXIS] and of z."""
    inverse_z = 1.0 / mean[2]
    scale = tl.load(view + FOCAL + AXIS) * inverse_z
    given = mean[AXIS] * inverse_z
    slope = limited_slope(view, given, AXIS)
    v_slope = -scale * dot(v, across)
    # Past the limit the slope has no derivative.
    v_slope = tl.where(slope == given, v_slope, 0.0)
    v_z = -inverse_z * (scale * dot(v, plus(along, scaled(-slope, across))) + v_slope * slope)
    return scaled(scale, v), scaled(-scale * slope, v), v_slope * inverse_z, v_z


@jit
def pinhole_backward(view, mean, axes, v):
    """From the gradient of the shape to those of ``mean`` and ``axes``."""
    vx, vy = factor(view, mean, axes[0], axes[2], 0), factor(view, mean, axes[1], axes[2], 1)
    c = cross(vx, vy)
    g_vx = plus(plus(scaled(2 * v[2], vx), scaled(v[4], vy)), scaled(2 * v[5], cross(vy, c)))
    g_vy = plus(plus(scaled(2 * v[3], vy), scaled(v[4], vx)), scaled(2 * v[5], cross(c, vx)))
    g_row_x, g_depth_x, g_x, g_zx = factor_backward(view, mean, axes[0], axes[2], g_vx, 0)
    g_row_y, g_depth_y, g_y, g_zy = factor_backward(view, mean, axes[1], axes[2], g_vy, 1)
    scale_x, scale_y = tl.load(view + FOCAL) / mean[2], tl.load(view + FOCAL + 1) / mean[2]
    g_z = g_zx + g_zy - (v[0] * scale_x * mean[0] + v[1] * scale_y * mean[1]) / mean[2]
    g_mean = (g_x + v[0] * scale_x, g_y + v[1] * scale_y, g_z)
    return g_mean, (g_row_x, g_row_y, plus(g_depth_x, g_depth_y))
