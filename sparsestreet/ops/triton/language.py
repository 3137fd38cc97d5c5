"""The language of kernels: functions for the GPU, and constants known at compile time."""

import inspect
from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl
from triton.runtime.jit import KernelInterface

_INTERPRETED = triton.knobs.runtime.interpret


def jit(function: Callable, **options: Any) -> KernelInterface:
    """Applies triton.jit to the bare function, because a type checker wrapped around it would hide its globals.

    Counts that change between renderings belong in ``do_not_specialize``. Otherwise the compiler makes one kernel for
    multiples of 16, one for 1 and one for the rest.
    """
    return triton.jit(inspect.unwrap(function), **options)


def constant(value: int | float | tuple[float, ...]) -> int | float | tuple[float, ...] | tl.constexpr:
    """A global number (or tuple of numbers) for kernels, wrapped as the compiler wants it.

    Triton's interpreter gets the bare number. There a wrapped number times a tensor would be wrapped again, which no
    function takes.
    """
    return value if _INTERPRETED else tl.constexpr(value)
