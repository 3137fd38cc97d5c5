"""Camera models of the kernels: a lens, a rolling shutter, and the unscented projection through both."""

import math

import triton.language as tl

from sparsestreet.ops.triton.launch import constant, jit
from sparsestreet.ops.triton.quaternions import cross, dot, plus, scaled
from sparsestreet.ops.triton.view import (
    CENTER,
    DISTORTION,
    FOCAL,
    FOLD,
    MOTION_FOCAL,
    NEAR,
    SHIFT,
    SIZE,
    SLOPE_LEAST,
    SLOPE_MOST,
    TURN,
    load_vector,
)


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


# Rows with a smaller a outrun the readout.
ROLL_LEAST = constant(0.1)


@jit
def drift(view, mean, moved):
    """Motion of the mean in the camera over the readout, meters; ``moved`` is its own displacement there."""
    turned = cross(load_vector(view + TURN), mean)
    return plus(moved, scaled(-1.0, plus(load_vector(view + SHIFT), turned)))


@jit
def normalized_speed(mean, dX):
    return (dX[0] - mean[0] / mean[2] * dX[2]) / mean[2], (dX[1] - mean[1] / mean[2] * dX[2]) / mean[2]


@jit
def velocity(view, mean, moved, DISTORTED: tl.constexpr):
    """Motion on the screen, pixels per readout: J dX with the exact Jacobian, through the distortion where given.

    It is reversed if the readout runs towards smaller coordinates."""
    n_x, n_y = normalized_speed(mean, drift(view, mean, moved))
    if DISTORTED:
        xx, xy, yy = jacobian(view, mean[0] / mean[2], mean[1] / mean[2])
        n_x, n_y = xx * n_x + xy * n_y, xy * n_x + yy * n_y
    return tl.load(view + MOTION_FOCAL) * n_x, tl.load(view + MOTION_FOCAL + 1) * n_y


@jit
def velocity_backward(view, mean, moved, v, DISTORTED: tl.constexpr):
    """From the gradient of the velocity to that of the mean in the camera."""
    dX, inverse = drift(view, mean, moved), 1.0 / mean[2]
    x, y = mean[0] * inverse, mean[1] * inverse
    n_x, n_y = normalized_speed(mean, dX)
    g_x, g_y = tl.load(view + MOTION_FOCAL) * v[0], tl.load(view + MOTION_FOCAL + 1) * v[1]
    v_x, v_y = 0 * g_x, 0 * g_y
    if DISTORTED:
        xxx, xxy, xyy, yyy = curvature(view, x, y)
        v_x = g_x * (xxx * n_x + xxy * n_y) + g_y * (xxy * n_x + xyy * n_y)
        v_y = g_x * (xxy * n_x + xyy * n_y) + g_y * (xyy * n_x + yyy * n_y)
        xx, xy, yy = jacobian(view, x, y)
        g_x, g_y = xx * g_x + xy * g_y, xy * g_x + yy * g_y
    v_x -= g_x * dX[2] * inverse
    v_y -= g_y * dX[2] * inverse
    v_z = -(g_x * n_x + g_y * n_y + v_x * x + v_y * y) * inverse
    v_drift = (g_x * inverse, g_y * inverse, -(g_x * x + g_y * y) * inverse)
    return plus((v_x * inverse, v_y * inverse, v_z), cross(load_vector(view + TURN), v_drift))


@jit
def exchanged(shape):
    """A shape (lens.py), or its gradient, with x and y exchanged."""
    return shape[1], shape[0], shape[3], shape[2], shape[4], shape[5]


@jit
def roll(view, shape, speed, COLUMNS: tl.constexpr):
    """The shape (lens.py) as it is read out, and a."""
    if COLUMNS:
        rolled, a = roll_rows(tl.load(view + SIZE), exchanged(shape), (speed[1], speed[0]))
        rolled = exchanged(rolled)
    else:
        rolled, a = roll_rows(tl.load(view + SIZE + 1), shape, speed)
    return rolled, a


@jit
def roll_rows(height, shape, speed):
    a, shear = 1 - speed[1] / height, speed[0] / height
    y = (shape[1] - 0.5 * speed[1]) / a
    x = shape[0] + speed[0] * (y / height - 0.5)
    # V'_y = V_y / a and V'_x = V_x + shear V'_y, in second moments.
    yy, xy = shape[3] / (a * a), shape[4] / a
    return (x, y, shape[2] + shear * (2 * xy + shear * yy), yy, xy + shear * yy, shape[5] / (a * a)), a


@jit
def roll_backward(view, shape, speed, v, COLUMNS: tl.constexpr):
    """From the gradient of the rolled shape to those of the shape and of the velocity."""
    if COLUMNS:
        width = tl.load(view + SIZE)
        v_shape, v_speed = roll_rows_backward(width, exchanged(shape), (speed[1], speed[0]), exchanged(v))
        v_shape, v_speed = exchanged(v_shape), (v_speed[1], v_speed[0])
    else:
        v_shape, v_speed = roll_rows_backward(tl.load(view + SIZE + 1), shape, speed, v)
    return v_shape, v_speed


@jit
def roll_rows_backward(height, shape, speed, v):
    a, shear = 1 - speed[1] / height, speed[0] / height
    y = (shape[1] - 0.5 * speed[1]) / a
    yy, xy = shape[3] / (a * a), shape[4] / a
    v_y = v[1] + v[0] * shear
    v_yy, v_xy = v[3] + shear * (v[4] + shear * v[2]), v[4] + 2 * shear * v[2]
    v_shear = 2 * v[2] * (xy + shear * yy) + v[4] * yy
    v_a = -(v_y * y + 2 * v_yy * yy + v_xy * xy + 2 * v[5] * shape[5] / (a * a)) / a
    v_speed = (v[0] * (y / height - 0.5) + v_shear / height, -0.5 * v_y / a - v_a / height)
    return (v[0], v_y / a, v[2], v_yy / (a * a), v_xy / a, v[5] / (a * a)), v_speed
