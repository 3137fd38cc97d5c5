"""How kernels are started: one place, so that tests can see what is compiled for what."""

from typing import Any

import numpy as np
import torch
from triton.runtime.interpreter import InterpretedFunction
from triton.runtime.jit import KernelInterface


def launch(
    kernel: KernelInterface,
    items: int,
    block: int,
    *arguments: Any,
    options: dict[str, Any] | None = None,
    **constants: Any,
) -> None:
    """Run ``kernel`` over ``items`` in programs of ``block``, given to it as BLOCK; nothing runs for no items.

    The first of ``arguments`` must be a tensor. ``options`` are the compiler's (num_warps, maxnreg, enable_fp_fusion).
    """
    if not items:
        return
    # The device of the first tensor need not be the current one. NumPy, which the interpreter computes in, would warn
    # of infinities in lanes that are masked off.
    with torch.cuda.device_of(arguments[0]), np.errstate(all="ignore"):
        kernel[(-(-items // block),)](*arguments, **constants, BLOCK=block, **(options or {}))


def is_interpreted(kernel: KernelInterface) -> bool:
    """Whether Triton's interpreter runs the kernel, on CPU tensors (TRITON_INTERPRET=1 when it was imported)."""
    return isinstance(kernel, InterpretedFunction)
