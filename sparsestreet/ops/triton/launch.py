"""Launches kernels in one place, so that tests can see what is compiled for which arguments.

For each launch Triton binds the arguments to names, specializes them, and looks up the kernel by a string of the
result.
This takes the host longer than many kernels take the device. Here a repeated launch calls the compiled kernel directly.
"""

import inspect
import warnings
from collections.abc import Callable
from functools import cache, reduce
from operator import attrgetter, or_
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor
from triton.compiler import CompiledKernel
from triton.runtime import driver
from triton.runtime.interpreter import InterpretedFunction
from triton.runtime.jit import KernelInterface

_INTERPRETED = triton.knobs.runtime.interpret


def jit(function: Callable, **options: Any) -> KernelInterface:
    """Apply triton.jit to the bare function, because a type checker wrapped around it would hide its globals.

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


_ALIGNED = 4
"""Numbers of 4 bytes in the 16 that kernels are compiled to expect the beginning of a vector at."""


def vectors(like: Tensor, *lengths: int, dtype: torch.dtype = torch.int32) -> tuple[Tensor, ...]:
    """Unwritten vectors of these lengths, of 4 bytes a number, on the device of ``like``.

    They are freed together, so they should be needed equally long.

    >>> [len(vector) for vector in vectors(torch.zeros(1), 3, 8)]
    [3, 8]
    """
    if not reduce(or_, lengths) % _ALIGNED:
        return like.new_empty(sum(lengths), dtype=dtype).split_with_sizes(lengths)
    pieces, places = [], []
    for length in lengths:
        places.append(len(pieces))
        pieces.append(length)
        if length % _ALIGNED:
            pieces.append(_ALIGNED - length % _ALIGNED)
    found = like.new_empty(sum(pieces), dtype=dtype).split_with_sizes(pieces)
    return tuple(found[place] for place in places)


_KNOWN = ("3.6.", "3.7.")
"""Versions of Triton for which a direct call is known to work.

Kinds of arguments are no coarser than their specialization. Their compiled kernels take the grid, what hooks get, and
then all arguments: tensors by address, and constants too."""
_INT32 = 1 << 31
_DTYPE = attrgetter("dtype")
_NONE: dict[str, Any] = {}
_MAX_NUMBERS = 256
"""Most numbers that are kept for a kernel, because counts of rows are new in many views."""
_PLANS: dict[tuple, "_Plan"] = {}


def launch(
    kernel: KernelInterface,
    items: int,
    block: int,
    *arguments: Any,
    options: dict[str, Any] | None = None,
    **constants: Any,
) -> None:
    """Run ``kernel`` over ``items`` in programs of ``block``, passed as BLOCK; without items nothing runs.

    ``arguments`` are tensors of one device, at least one, and then numbers. ``constants`` are the kernel's other
    constants, ``options`` those of the compiler (num_warps, maxnreg, enable_fp_fusion). Raises TypeError for arguments
    other than tensors, ints and floats.
    """
    if not items:
        return
    options = options or _NONE
    # Names and values apart, because that takes half the time of pairs.
    key = (kernel.fn, block, *constants, *constants.values(), *options, *options.values())
    plan = _PLANS.get(key)
    if plan is None:
        plan = _PLANS[key] = _Plan(kernel, arguments, constants | {"BLOCK": block}, options)
    plan.launch((-(-items // block), 1, 1), arguments)


class _Plan:
    """A kernel with its constants, and what it was compiled to for each kind of arguments."""

    def __init__(self, kernel: KernelInterface, arguments: tuple, constants: dict[str, Any], options: dict[str, Any]):
        self._kernel, self._constants, self._options = kernel, constants, options
        self._filling = tuple(constants.values())
        self._interpreted = is_interpreted(kernel)
        self._tensors = sum(isinstance(value, Tensor) for value in arguments)
        self._by_kind: dict[tuple, CompiledKernel] = {}
        self._by_numbers: dict[tuple, CompiledKernel] = {}

    def launch(self, grid: tuple[int, int, int], arguments: tuple) -> None:
        if self._interpreted:
            # The interpreter computes in NumPy, which would warn of infinities in masked lanes.
            with np.errstate(all="ignore"):
                self._kernel[grid](*arguments, **self._constants, **self._options)
            return
        tensors, numbers = arguments[: self._tensors], arguments[self._tensors :]
        # Tensors are passed by address; for a tensor the launcher would ask the driver where it lies.
        addresses = tuple(map(Tensor.data_ptr, tensors))
        device = tensors[0].get_device()
        # Triton starts kernels on the current device.
        if device >= 0 and device != torch.cuda.current_device():
            with torch.cuda.device(device):
                self._start(grid, device, addresses, tensors, numbers)
        else:
            self._start(grid, device, addresses, tensors, numbers)

    def _start(
        self, grid: tuple[int, int, int], device: int, addresses: tuple[int, ...], tensors: tuple, numbers: tuple
    ) -> None:
        key = (device, _alignment(addresses), *map(_DTYPE, tensors), *map(type, numbers), *numbers)
        compiled = self._by_numbers.get(key)
        if compiled is None:
            # Most numbers come again, and are then not looked at one by one.
            kind = (*key[: 2 + len(tensors)], *map(_kind, numbers))
            compiled = self._by_kind.get(kind)
            if compiled is None:
                compiled = self._kernel[grid](*tensors, *numbers, **self._constants, **self._options)
                # A hook of Triton may have prevented the compilation.
                if isinstance(compiled, CompiledKernel) and _is_known(triton.__version__):
                    self._by_kind[kind] = compiled
                return
            if len(self._by_numbers) >= _MAX_NUMBERS:
                self._by_numbers.clear()
            self._by_numbers[key] = compiled
        # Constants only fill their places in the signature; the machine code has them already.
        _start(compiled, device, grid, (*addresses, *numbers, *self._filling))


def _start(compiled: CompiledKernel, device: int, grid: tuple[int, int, int], arguments: tuple) -> None:
    hooks = triton.knobs.runtime
    if hooks.launch_enter_hook.calls or hooks.launch_exit_hook.calls:
        compiled[grid](*arguments)
    else:
        # The same call without hooks.
        stream = driver.active.get_current_stream(device)
        compiled.run(*grid, stream, compiled.function, compiled.packed_metadata, None, None, None, *arguments)


def _alignment(addresses: tuple[int, ...]) -> tuple[bool, ...] | None:
    """Which addresses are multiples of 16, as kernels are compiled for; None: all, as almost always."""
    return tuple(address % 16 == 0 for address in addresses) if reduce(or_, addresses) % 16 else None


def _kind(number: Any) -> object:
    """The properties of a number that select a compiled kernel, at least as fine as Triton's specialization."""
    if type(number) is int:
        return number == 1, number % 16 == 0, -_INT32 <= number < _INT32
    if type(number) is float:
        return float
    raise TypeError(f"arguments of kernels must be tensors, ints or floats, got {number!r}: pass it as a constant")


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
