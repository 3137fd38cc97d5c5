"""Lens distortion: the polynomial of Brown and Conrady, and a Gaussian's shape through it by the unscented transform.

Unscented transform: Julier and Uhlmann 1997; for splats 3DGUT, Wu et al. 2025. With alpha = 1, beta = 2, kappa = 0 in
3 dimensions lambda is 0. The six points mu +- sqrt(3) a_k have weight 1/6; mu has 0 in the mean and 2 in the
covariance. All weights are >= 0, so the covariance is V V^T with columns sqrt(w_i) (p_i - m), as for the pinhole.
Points lie along the second axis of a block: mu, +a_1..3, -a_1..3, and one of weight 0.
"""

import math

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.view import CENTER, DISTORTION, FOCAL, FOLD, NEAR

POINTS = constant(8)
SQRT3 = constant(math.sqrt(3))
SIXTH = constant(1 / 6)


@jit
def radial(view, r2):
    """The radial polynomial and its first two derivatives by r2."""
    k1, k2, k3 = tl.load(view + DISTORTION), tl.load(view + DISTORTION + 1), tl.load(view + DISTORTION + 4)
    return 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3), 2 * k2 + r2 * 6 * k3


@jit
def distort(view, x, y):
    """Normalized coordinates as the lens shows them."""
    p1, p2 = tl.load(view + DISTORTION + 2), tl.load(view + DISTORTION + 3)
    r2 = x * x + y * y
    f, _, _ = radial(view, r2)
    return x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@jit
def jacobian(view, x, y):
    """(D_xx, D_xy, D_yy): the distortion is the gradient of a potential, so D_xy = D_yx."""
    p1, p2 = tl.load(view + DISTORTION + 2), tl.load(view + DISTORTION + 3)
    f, f1, _ = radial(view, x * x + y * y)
    mixed = 2 * (x * y * f1 + p1 * x + p2 * y)
    return f + 2 * x * x * f1 + 2 * p1 * y + 6 * p2 * x, mixed, f + 2 * y * y * f1 + 6 * p1 * y + 2 * p2 * x


@jit
def curvature(view, x, y):
    """(D_xxx, D_xxy, D_xyy, D_yyy): derivatives of the Jacobian."""
    p1, p2 = tl.load(view + DISTORTION + 2), tl.load(view + DISTORTION + 3)
    _, f1, f2 = radial(view, x * x + y * y)
    return (
        6 * x * f1 + 4 * x * x * x * f2 + 6 * p2,
        2 * y * f1 + 4 * x * x * y * f2 + 2 * p1,
        2 * x * f1 + 4 * x * y * y * f2 + 2 * p2,
        6 * y * f1 + 4 * y * y * y * f2 + 6 * p1,
    )


@jit
def within_fold(view, mean):
    """Whether the lens sees the point (geometry/lenses.py says where its range ends)."""
    x, y = mean[0] / mean[2], mean[1] / mean[2]
    return x * x + y * y <= tl.load(view + FOLD)


@jit
def shrink(view, x, y):
    """s = min(1, sqrt(r2_max / r2)); beyond the fold the map continues as D(s x) / s."""
    r2, fold = x * x + y * y, tl.load(view + FOLD)
    beyond = r2 > fold
    return tl.where(beyond, tl.sqrt(fold / tl.where(beyond, r2, 1.0)), 1.0)


@jit
def shown(view, x, y):
    """Pixels relative to the principal point (so that differences keep their digits), beyond the fold as well."""
    s = shrink(view, x, y)
    at_x, at_y = distort(view, s * x, s * y)
    return tl.load(view + FOCAL) * at_x / s, tl.load(view + FOCAL + 1) * at_y / s


@jit
def shown_backward(view, x, y, v_x, v_y):
    """From the gradient of pixels to that of normalized coordinates.

    With s proportional to 1/|p|, d(D(s p) / s) = D' dp - (D' p - D(s p) / s) (p . dp) / |p|^2.
    """
    s = shrink(view, x, y)
    g_x, g_y = tl.load(view + FOCAL) * v_x, tl.load(view + FOCAL + 1) * v_y
    xx, xy, yy = jacobian(view, s * x, s * y)
    at_x, at_y = distort(view, s * x, s * y)
    along = g_x * (xx * x + xy * y - at_x / s) + g_y * (xy * x + yy * y - at_y / s)
    beyond = s < 1
    inward = tl.where(beyond, along / tl.where(beyond, x * x + y * y, 1.0), 0.0)
    return xx * g_x + xy * g_y - inward * x, xy * g_x + yy * g_y - inward * y


@jit
def stretch():
    """How far each point goes along its axis: 0, sqrt(3) three times, -sqrt(3) three times, 0."""
    point = tl.arange(0, POINTS)[None, :]
    return tl.where((point == 0) | (point == 7), 0.0, tl.where(point < 4, SQRT3, -SQRT3))


@jit
def covariance_roots():
    """sqrt(w_i) of the covariance: sqrt(2), 1 / sqrt(6) six times, 0."""
    point = tl.arange(0, POINTS)[None, :]
    return tl.where(point == 0, 1.4142135623730951, tl.where(point == 7, 0.0, 0.4082482904638631))


@jit
def mean_weights():
    point = tl.arange(0, POINTS)[None, :]
    return tl.where((point == 0) | (point == 7), 0.0, SIXTH)


@jit
def on_axis(point, K: tl.constexpr):
    """Whether a point lies on axis K."""
    return (point == K + 1) | (point == K + 4)


@jit
def sigma(center, row):
    """One coordinate of the points; ``row`` holds that coordinate of the three axes."""
    point = tl.arange(0, POINTS)[None, :]
    axis = tl.where(on_axis(point, 0), row[0][:, None], tl.where(on_axis(point, 1), row[1][:, None], row[2][:, None]))
    return center[:, None] + stretch() * axis


@jit
def sigma_backward(v):
    """From the gradient of one coordinate of the points to those of the center and of the three axes."""
    point, g = tl.arange(0, POINTS)[None, :], stretch() * v
    along = (
        tl.sum(tl.where(on_axis(point, 0), g, 0.0), 1),
        tl.sum(tl.where(on_axis(point, 1), g, 0.0), 1),
        tl.sum(tl.where(on_axis(point, 2), g, 0.0), 1),
    )
    return tl.sum(v, 1), along


@jit
def normalized_points(view, mean, axes):
    """x/z and y/z of the points, 1/z, and whether z stayed unchanged by its limit z >= near."""
    depth, near = sigma(mean[2], axes[2]), tl.load(view + NEAR)
    inverse = 1.0 / tl.maximum(depth, near)
    return sigma(mean[0], axes[0]) * inverse, sigma(mean[1], axes[1]) * inverse, inverse, depth >= near


@jit
def screen_factor(view, x, y):
    """Mean on the screen relative to the principal point, and the rows of V, 8 columns."""
    at_x, at_y = shown(view, x, y)
    m_x, m_y = tl.sum(at_x * mean_weights(), 1), tl.sum(at_y * mean_weights(), 1)
    return m_x, m_y, covariance_roots() * (at_x - m_x[:, None]), covariance_roots() * (at_y - m_y[:, None])


@jit
def minors(vx, vy):
    """All 2x2 minors of V."""
    return vx[:, :, None] * vy[:, None, :] - vx[:, None, :] * vy[:, :, None]


@jit
def unscented(view, mean, axes):
    """Shape on the screen (lens.py) of a Gaussian seen through the lens."""
    x, y, _, _ = normalized_points(view, mean, axes)
    m_x, m_y, vx, vy = screen_factor(view, x, y)
    c = minors(vx, vy)
    bare = 0.5 * tl.sum(tl.sum(c * c, 2), 1)
    m_x, m_y = m_x + tl.load(view + CENTER), m_y + tl.load(view + CENTER + 1)
    return m_x, m_y, tl.sum(vx * vx, 1), tl.sum(vy * vy, 1), tl.sum(vx * vy, 1), bare


@jit
def point_gradient(v_mean, g):
    """From the gradients of the screen mean and of V's row to those of the points' pixels."""
    g = covariance_roots() * g
    return g + mean_weights() * (v_mean - tl.sum(g, 1))[:, None]


@jit
def unscented_backward(view, mean, axes, v):
    """From the gradient of the shape to those of ``mean`` and ``axes``."""
    x, y, inverse, free = normalized_points(view, mean, axes)
    _, _, vx, vy = screen_factor(view, x, y)
    c = minors(vx, vy)
    g_x = 2 * (v[2][:, None] * vx + v[5][:, None] * tl.sum(c * vy[:, None, :], 2)) + v[4][:, None] * vy
    g_y = 2 * (v[3][:, None] * vy + v[5][:, None] * tl.sum(c * vx[:, :, None], 1)) + v[4][:, None] * vx
    v_x, v_y = shown_backward(view, x, y, point_gradient(v[0], g_x), point_gradient(v[1], g_y))
    v_depth = tl.where(free, -(v_x * x + v_y * y) * inverse, 0.0)
    mean_x, row_x = sigma_backward(v_x * inverse)
    mean_y, row_y = sigma_backward(v_y * inverse)
    mean_z, row_z = sigma_backward(v_depth)
    return (mean_x, mean_y, mean_z), (row_x, row_y, row_z)
