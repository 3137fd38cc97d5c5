"""Vectors and matrices of a lane: tuples of three numbers, and of three rows; reading and writing of vectors."""

import triton.language as tl

from sparsestreet.ops.triton.language import jit


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
