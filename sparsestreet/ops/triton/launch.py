"""Launches kernels in one place, so that tests can see what is compiled for which arguments.

For each launch Triton binds the arguments to names, specializes them, and looks up the kernel by a string of the
result.
This takes the host longer than many kernels take the device. Here a repeated launch calls the compiled kernel directly.
"""

import warnings
from contextlib import nullcontext
from functools import cache
from typing import Any

import numpy as np
import torch
import triton
from torch import Tensor
from triton.compiler import CompiledKernel
from triton.runtime import driver
from triton.runtime.interpreter import InterpretedFunction
from triton.runtime.jit import KernelInterface

_KNOWN = ("3.6.", "3.7.")
"""Versions of Triton for which a direct call is known to work.

``_kinds`` is no coarser than their specialization. Their compiled kernels take the grid, what hooks get, and then all
arguments: tensors by address, and constants too."""
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
    """Runs ``kernel`` over ``items`` in programs of ``block``, passed as BLOCK; without items nothing runs.

    The first of ``arguments`` must be a tensor. ``constants`` are the kernel's other constants, ``options`` those of
    the
    compiler (num_warps, maxnreg, enable_fp_fusion). Raises TypeError for arguments other than tensors, ints and floats.
    """
    if not items:
        return
    grid, options, constants = (-(-items // block), 1, 1), options or {}, constants | {"BLOCK": block}
    # Tensors are passed by address; for a tensor the launcher would ask the driver where it lies.
    given = [value.data_ptr() if isinstance(value, Tensor) else value for value in arguments]
    key = (kernel.fn, *_kinds(arguments, given), *constants.items(), *options.items())
    if is_interpreted(kernel):
        # The interpreter computes in NumPy, which would warn of infinities in masked lanes.
        with np.errstate(all="ignore"):
            kernel[grid](*arguments, **constants, **options)
        return
    compiled, device = _COMPILED.get(key), arguments[0].get_device()
    # Triton starts kernels on the current device.
    elsewhere = device >= 0 and device != torch.cuda.current_device()
    with torch.cuda.device(device) if elsewhere else nullcontext():
        if compiled is not None:
            # Constants only fill their places in the signature; the machine code has them already.
            _start(compiled, device, grid, (*given, *constants.values()))
            return
        compiled = kernel[grid](*arguments, **constants, **options)
    # A hook of Triton may have prevented the compilation.
    if isinstance(compiled, CompiledKernel) and _is_known(triton.__version__):
        _COMPILED[key] = compiled


def _start(compiled: CompiledKernel, device: int, grid: tuple[int, int, int], arguments: tuple) -> None:
    hooks = triton.knobs.runtime
    if hooks.launch_enter_hook.calls or hooks.launch_exit_hook.calls:
        compiled[grid](*arguments)
    else:
        # The same call without hooks.
        stream = driver.active.get_current_stream(device)
        compiled.run(*grid, stream, compiled.function, compiled.packed_metadata, None, None, None, *arguments)


def _kinds(arguments: tuple, given: list) -> list[tuple[object, ...] | type]:
    """The properties of arguments (``given`` by value or address) that select a compiled kernel.

    They are at least as fine as Triton's specialization, and include the device."""
    return [
        (value.dtype, value.get_device(), number % 16 == 0)
        if value is not number
        else (value == 1, value % 16 == 0, -_INT32 <= value < _INT32)
        if type(value) is int
        else _float_of(value)
        for value, number in zip(arguments, given, strict=True)
    ]


def _float_of(value: Any) -> type:
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


def stream_of(device: torch.device) -> int:
    """The stream on which kernels and copies of a device start; 0 on the host."""
    return 0 if device.type == "cpu" else driver.active.get_current_stream(device.index)


def is_interpreted(kernel: KernelInterface) -> bool:
    """Whether Triton's interpreter runs the kernel, on CPU tensors (TRITON_INTERPRET=1 when it was imported)."""
    return isinstance(kernel, InterpretedFunction)
