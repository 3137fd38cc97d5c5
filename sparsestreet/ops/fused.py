"""Chooses between implementations of a training step: plain torch for any device, the C++ library, fused Triton."""

from torch import Tensor, float32, float64

from sparsestreet.ops.backend import TRITON_REMEDY, has_triton
from sparsestreet.ops.cpu.library import find_library, remedy

CHOICES = ("torch", "cpu", "triton")


def fused_backend(backend: str, *tensors: Tensor, choices: tuple[str, ...] = CHOICES) -> str:
    """Returns which of ``choices`` runs a step on these tensors, all on one device; for "auto" the fastest.

    The C++ library ("cpu") takes tensors on the CPU that are all float32 or all float64. "triton" takes contiguous
    float32 tensors on a CUDA device; if it is named, also on the CPU, by Triton's interpreter. Results differ only by
    rounding. So "auto" takes torch for all other tensors, and if the library is not built or triton is missing.

    Raises ValueError for an unknown name, or for tensors that the named backend does not take. Raises RuntimeError with
    the remedy if the named backend is not installed.
    """
    if backend not in ("auto", *choices):
        raise ValueError(f"no backend {backend!r} of this step: choose one of {('auto', *choices)}")
    if backend == "cpu":
        _require_library(tensors)
    if backend == "triton":
        _require_triton(tensors)
    if backend != "auto":
        return backend
    if "cpu" in choices and _fit_library(tensors) and find_library() is not None:
        return "cpu"
    if "triton" in choices and _on_gpu(tensors) and _fit_triton(tensors) and has_triton():
        return "triton"
    return "torch"


def _on_gpu(tensors: tuple[Tensor, ...]) -> bool:
    return {tensor.device.type for tensor in tensors} == {"cuda"}


def _fit_library(tensors: tuple[Tensor, ...]) -> bool:
    return {(tensor.dtype, tensor.device.type) for tensor in tensors} in ({(float32, "cpu")}, {(float64, "cpu")})


def _fit_triton(tensors: tuple[Tensor, ...]) -> bool:
    return all(tensor.dtype == float32 and tensor.is_contiguous() for tensor in tensors)


def _require_library(tensors: tuple[Tensor, ...]) -> None:
    if not _fit_library(tensors):
        kinds = {(tensor.dtype, tensor.device.type) for tensor in tensors}
        raise ValueError(f"backend 'cpu' takes float32 or float64 tensors on the CPU, got {kinds}: use backend='torch'")
    if find_library() is None:
        raise RuntimeError(f"backend 'cpu' needs the C++ library: {remedy()}")


def _require_triton(tensors: tuple[Tensor, ...]) -> None:
    if not has_triton():
        raise RuntimeError(f"backend 'triton' needs the package triton: {TRITON_REMEDY}")
    if not _fit_triton(tensors):
        kinds = [(tensor.dtype, tensor.stride()) for tensor in tensors]
        raise ValueError(f"backend 'triton' takes contiguous float32 tensors, got {kinds}: use backend='torch'")
    device = tensors[0].device
    if device.type != "cuda" and not _interpreting():
        raise ValueError(f"backend 'triton' needs tensors on a CUDA device, got {device}: use backend='torch'")


def _interpreting() -> bool:
    from triton import knobs

    return knobs.runtime.interpret
