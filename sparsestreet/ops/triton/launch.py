"""How kernels are started: one place, so that tests can see what is compiled for what.

Triton binds the arguments of each launch to names, specializes them and looks the kernel up by a text of all that,
which takes the host longer than many a kernel takes the device. A launch like an earlier one goes to the compiled
kernel at once.
"""

import warnings
from functools import cache
from typing import Any

import numpy as np
import torch
import triton
from torch import Tensor
from triton.compiler import CompiledKernel
from triton.runtime.interpreter import InterpretedFunction
from triton.runtime.jit import KernelInterface

_KNOWN = ("3.6.", "3.7.")
"""Versions of Triton whose specialization ``_kind`` is no coarser than, and whose compiled kernels take the grid and
then all arguments, constants too."""
_INT32 = 1 << 31
_COMPILED: dict[tuple, CompiledKernel] = {}


def launch(
    kernel: KernelInterface,
    items: int,
    block: int,
    *arguments: Any,
    options: dict[str, Any] | None = None,
    **constants: Any,
) -> None:
    """Run ``kernel`` over ``items`` in programs of ``block``, given to it as BLOCK; nothing runs for no items.

    The first of ``arguments`` must be a tensor. ``constants`` are all others that the kernel takes, ``options`` the
    compiler's (num_warps, maxnreg, enable_fp_fusion). Raises TypeError for arguments that are no tensors, ints or
    floats.
    """
    if not items:
        return
    grid, options, constants = (-(-items // block), 1, 1), options or {}, constants | {"BLOCK": block}
    device = arguments[0].get_device()
    key = (kernel.fn, device, tuple([_kind(value) for value in arguments]), *constants.items(), *options.items())
    if is_interpreted(kernel):
        # NumPy, which the interpreter computes in, would warn of infinities in lanes that are masked off.
        with np.errstate(all="ignore"):
            kernel[grid](*arguments, **constants, **options)
        return
    if device < 0 or device == torch.cuda.current_device():
        _launch_here(key, kernel, grid, arguments, constants, options)
        return
    with torch.cuda.device(device):
        _launch_here(key, kernel, grid, arguments, constants, options)


def _launch_here(
    key: tuple, kernel: KernelInterface, grid: tuple[int, int, int], arguments: tuple, constants: dict, options: dict
) -> None:
    compiled = _COMPILED.get(key)
    if compiled is not None:
        # Constants fill their places in the signature; the machine code has them already.
        compiled[grid](*arguments, *constants.values())
        return
    compiled = kernel[grid](*arguments, **constants, **options)
    # A hook of Triton's may have kept it from compiling.
    if isinstance(compiled, CompiledKernel) and _is_known(triton.__version__):
        _COMPILED[key] = compiled


def _kind(value: Any) -> tuple[object, ...] | type:
    """What a kernel is compiled for of an argument: never less than what Triton specializes."""
    if isinstance(value, Tensor):
        return value.dtype, value.data_ptr() % 16 == 0
    if type(value) is int:
        return value == 1, value % 16 == 0, -_INT32 <= value < _INT32
    if type(value) is float:
        return float
    raise TypeError(f"arguments of kernels must be tensors, ints or floats, got {value!r}: pass it as a constant")


@cache
def _is_known(version: str) -> bool:
    known = version.startswith(_KNOWN)
    if not known:
        warnings.warn(
            f"Triton {version} is not among the versions whose launches can safely be shortened "
            f"({', '.join(name + 'x' for name in _KNOWN)}): each takes the host twice as long; install one of them",
            stacklevel=2,
        )
    return known


def is_interpreted(kernel: KernelInterface) -> bool:
    """Whether Triton's interpreter runs the kernel, on CPU tensors (TRITON_INTERPRET=1 when it was imported)."""
    return isinstance(kernel, InterpretedFunction)
