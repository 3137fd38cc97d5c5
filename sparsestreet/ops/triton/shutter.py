"""Rolling shutter: a splat that moves while rows are read one after the other is again a 2D Gaussian.

A point at p + u tau, read at image row y with tau = y / H - 1/2, is seen where y = p_y + u_y (y / H - 1/2). So the map
from p to the seen point is linear, with a = 1 - u_y / H.

Read from the bottom, tau changes its sign, which is the same as a motion -u. Columns are rows of the image with x and y
exchanged.
"""

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.unscented import curvature, jacobian
from sparsestreet.ops.triton.vectors import cross, plus, scaled
from sparsestreet.ops.triton.view import MOTION_FOCAL, SHIFT, SIZE, TURN, load_vector

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
