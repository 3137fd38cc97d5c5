"""The record of a visible splat, which kernels after the projection read: 12 numbers (48 bytes), the last its gate."""

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit

LENGTH = 12
RECORD = constant(LENGTH)
X, Y, L11, L21, L22, LOG2_OPACITY = (constant(i) for i in range(6))
# The exponent of 2 below which the splat is not drawn; then the color's three numbers and the depth.
CUTOFF, COLOR, DEPTH = constant(6), constant(7), constant(10)
# Written where rows have gates; of those without, nothing reads it.
GATE_PLACE = 11
GATE = constant(GATE_PLACE)


@jit
def record_of(records, row):
    """Pointer to the record of a row."""
    return records + row.to(tl.int64) * RECORD
