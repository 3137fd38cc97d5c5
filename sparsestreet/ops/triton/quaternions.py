"""Vectors of three and quaternions as tuples of numbers, with their derivatives."""

import triton.language as tl

from sparsestreet.ops.triton.launch import constant, jit


@jit
def load_row(field, row, mask, COUNT: tl.constexpr):
    """COUNT numbers of each lane's row."""
    values = ()
    for i in tl.static_range(COUNT):
        values += (tl.load(field + row * COUNT + i, mask, 0.0),)
    return values


@jit
def store_row(field, row, values, mask, COUNT: tl.constexpr):
    for i in tl.static_range(COUNT):
        tl.store(field + row * COUNT + i, values[i], mask)


@jit
def scaled(k, a):
    return k * a[0], k * a[1], k * a[2]


@jit
def plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit
def times(m, v):
    """m v."""
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@jit
def transposed_times(m, v):
    """m^T v."""
    return plus(plus(scaled(v[0], m[0]), scaled(v[1], m[1])), scaled(v[2], m[2]))


@jit
def product(a, b):
    """Matrix product a b."""
    return transposed_times(b, a[0]), transposed_times(b, a[1]), transposed_times(b, a[2])


@jit
def transposed(m):
    return (m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2])


# Of geometry/quaternions.py, in float32: the length below which gradients stop growing.
SHORTEST = constant(2.0**-126 / 2.0**-23)


@jit
def inner(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@jit
def weighted(k, a, m, b):
    """k a + m b."""
    return k * a[0] + m * b[0], k * a[1] + m * b[1], k * a[2] + m * b[2], k * a[3] + m * b[3]


@jit
def unit_quaternion(q):
    """Unit quaternion and 1 / length; an exact zero is the identity with 1 / length 0.

    It is divided by the largest component first, because squares leave float32's range long before the length does.
    1 / length is at most 1 / SHORTEST, because it would leave that range too.
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
def unit_backward(q, inverse_length, v):
    """From the gradient of a unit quaternion to that of the given one."""
    return weighted(inverse_length, v, -inverse_length * inner(v, q), q)


@jit
def rotation_of(q):
    """The matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@jit
def rotation_backward(q, v):
    """From the gradient of the matrix to that of the unit quaternion."""
    a, b, c = v[0], v[1], v[2]
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        2 * (x * (c[1] - b[2]) + y * (a[2] - c[0]) + z * (b[0] - a[1])),
        2 * (w * (c[1] - b[2]) + y * (a[1] + b[0]) + z * (a[2] + c[0])) - 4 * x * (b[1] + c[2]),
        2 * (w * (a[2] - c[0]) + x * (a[1] + b[0]) + z * (b[2] + c[1])) - 4 * y * (a[0] + c[2]),
        2 * (w * (b[0] - a[1]) + x * (a[2] + c[0]) + y * (b[2] + c[1])) - 4 * z * (a[0] + b[1]),
    )


@jit
def conjugate(q):
    return q[0], -q[1], -q[2], -q[3]


@jit
def multiply(a, b):
    """The Hamilton product; with one factor conjugated it is its own transpose."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )
