"""Search in sorted numbers, for kernels."""

import triton.language as tl

from sparsestreet.ops.triton.language import jit


@jit
def first_at_least(values, least, count, steps):
    """Index of the first of ``count`` sorted numbers that is not below ``least``; count < 2^steps."""
    low = tl.zeros_like(least)
    high = low + count
    for _ in range(steps):
        middle = (low + high) // 2
        below = (low < high) & (tl.load(values + middle, low < high, 0) < least)
        low, high = tl.where(below, middle + 1, low), tl.where(below, high, middle)
    return low
