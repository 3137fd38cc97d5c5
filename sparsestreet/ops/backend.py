"""The backends of the ops, and which one runs on a device or on tensors."""

import functools
import importlib.util
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor, float32, float64

from sparsestreet.ops.cpu.library import find_library, remedy

BACKENDS = ("reference", "cpu", "triton")
TRITON_REMEDY = "pip install 'sparsestreet[gpu]' (Linux)"


def resolve_backend(name: str, device: torch.device) -> str:
    """Return ``name`` if it can run on ``device``, or for "auto" the fastest backend that can.

    "auto" takes "triton" on CUDA devices and "cpu" on the CPU; if they are missing, it takes "reference" and warns
    once. Raises ValueError for an unknown name or a device the backend does not run on. Raises RuntimeError with the
    remedy if the library of "cpu" is not built, or the package triton is not installed.

    >>> resolve_backend("reference", torch.device("cpu"))
    'reference'
    >>> resolve_backend("cpu", torch.device("meta"))
    Traceback (most recent call last):
    ValueError: backend 'cpu' needs tensors on the cpu, got meta: move them or use 'reference'
    """
    if name not in (*BACKENDS, "auto"):
        raise ValueError(f"no splat backend {name!r}: choose one of {sorted(BACKENDS)} or 'auto'")
    if name == "reference":
        return name
    if name == "cpu":
        if device.type != "cpu":
            raise ValueError(f"backend 'cpu' needs tensors on the cpu, got {device}: move them or use 'reference'")
        if find_library() is None:
            raise RuntimeError(f"backend 'cpu' is not built: {remedy()}")
        return name
    if name == "triton":
        if device.type not in ("cuda", "cpu"):
            raise ValueError(f"backend 'triton' needs tensors on a CUDA device, got {device}: move them")
        if not has_triton():
            raise RuntimeError(f"backend 'triton' needs the package triton: {TRITON_REMEDY}")
        return name
    return _fastest(device)


def has_triton() -> bool:
    """Whether the package triton is installed; does not import it."""
    return importlib.util.find_spec("triton") is not None


def _fastest(device: torch.device) -> str:
    if device.type == "cuda" and has_triton():
        return "triton"
    if device.type == "cpu" and find_library() is not None:
        return "cpu"
    if device.type == "cpu":
        _warn_once(f"the C++ splat library is not built, so the dense reference renders, slowly: {remedy()}")
    elif device.type == "cuda":
        _warn_once(f"triton is not installed, so the dense reference renders, slowly: {TRITON_REMEDY}")
    else:
        _warn_once(f"no fast splat backend runs on {device}, so the dense reference renders, slowly: use the cpu")
    return "reference"


_warned: set[str] = set()


def _warn_once(message: str) -> None:
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, RuntimeWarning, stacklevel=5)


CHOICES = ("torch", "cpu", "triton")


def fused_backend(backend: str, *tensors: Tensor, choices: tuple[str, ...] = CHOICES) -> str:
    """Return which of ``choices`` runs a step on these tensors, all on one device; for "auto" the fastest.

    The C++ library ("cpu") takes tensors on the CPU that are all float32 or all float64. "triton" takes contiguous
    float32 tensors on a CUDA device; if it is named, also on the CPU, by Triton's interpreter. Results differ only by
    rounding. So "auto" takes torch for all other tensors, and if the library is not built or triton is missing.

    Raises ValueError for an unknown name, or for tensors that the named backend does not take. Raises RuntimeError with
    the remedy if the named backend is not installed.
    """
    if backend not in ("auto", *choices):
        raise ValueError(f"no backend {backend!r} of this step: choose one of {('auto', *choices)}")
    kinds = {(tensor.dtype, tensor.device.type) for tensor in tensors}
    for_library = kinds in ({(float32, "cpu")}, {(float64, "cpu")})
    for_triton = all(tensor.dtype == float32 and tensor.is_contiguous() for tensor in tensors)
    if backend == "auto":
        if "cpu" in choices and for_library and find_library() is not None:
            return "cpu"
        if "triton" in choices and _on_gpu(tensors) and for_triton and has_triton():
            return "triton"
        return "torch"
    if backend == "cpu":
        if not for_library:
            raise ValueError(
                f"backend 'cpu' takes float32 or float64 tensors on the CPU, got {kinds}: use backend='torch'"
            )
        if find_library() is None:
            raise RuntimeError(f"backend 'cpu' needs the C++ library: {remedy()}")
    if backend == "triton":
        if not has_triton():
            raise RuntimeError(f"backend 'triton' needs the package triton: {TRITON_REMEDY}")
        if not for_triton:
            laid_out = [(tensor.dtype, tensor.stride()) for tensor in tensors]
            raise ValueError(f"backend 'triton' takes contiguous float32 tensors, got {laid_out}: use backend='torch'")
        device = tensors[0].device
        if device.type != "cuda" and not _interpreting():
            raise ValueError(f"backend 'triton' needs tensors on a CUDA device, got {device}: use backend='torch'")
    return backend


def _on_gpu(tensors: tuple[Tensor, ...]) -> bool:
    return {tensor.device.type for tensor in tensors} == {"cuda"}


def _interpreting() -> bool:
    from triton import knobs

    return knobs.runtime.interpret


P = ParamSpec("P")
Result = TypeVar("Result")


def disable_compile(op: Callable[P, Result]) -> Callable[P, Result]:
    """Return ``op``, which a compiled function then calls uncompiled: the graph breaks there.

    Dynamo would otherwise trace into the choice of the backend and the library's pointers, and warn. The function
    ``torch.compiler.disable`` does the same, but imports the compiler at once, which takes as long as torch itself.
    """

    @functools.wraps(op)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            # torch's annotation takes the function for the decorator with options, and so for what makes one.
            return torch.compiler.disable(op)(*args, **kwargs)  # pyright: ignore[reportCallIssue]
        return op(*args, **kwargs)

    return call
