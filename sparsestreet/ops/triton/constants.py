"""Numbers that kernels know when they are compiled."""

import triton
import triton.language as tl

_INTERPRETED = triton.knobs.runtime.interpret


def constant(value: float) -> float | tl.constexpr:
    """A global number for kernels, wrapped as the compiler wants it.

    Triton's interpreter gets it as it is: there a wrapped number times a tensor would be wrapped again, and no function
    takes that.
    """
    return value if _INTERPRETED else tl.constexpr(value)
