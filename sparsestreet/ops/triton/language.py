"""What kernels are written with: functions for the GPU, and numbers that are known when they are compiled."""

import inspect
from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl
from triton.runtime.jit import KernelInterface

_INTERPRETED = triton.knobs.runtime.interpret


def jit(function: Callable, **options: Any) -> KernelInterface:
    """triton.jit of the function as it is written: a type checker wrapped around it would hide its globals.

    Counts that change from one rendering to the next belong in ``do_not_specialize``: the compiler would make a kernel
    for multiples of 16, one for 1 and one for the rest.
    """
    return triton.jit(inspect.unwrap(function), **options)


def constant(value: int | float | tuple[float, ...]) -> int | float | tuple[float, ...] | tl.constexpr:
    """A global number (or tuple of numbers) for kernels, wrapped as the compiler wants it.

    Triton's interpreter gets it as it is: there a wrapped number times a tensor would be wrapped again, and no function
    takes that.
    """
    return value if _INTERPRETED else tl.constexpr(value)
