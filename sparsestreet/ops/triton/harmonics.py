"""Real spherical harmonics to degree 3 (ops/spherical_harmonics.py has the same in torch) and their derivative."""

import math

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.vectors import dot, plus, scaled, times, transposed_times

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
