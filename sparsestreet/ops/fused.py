"""Steps of training with two implementations: plain torch for any device, and one fused Triton kernel."""

from torch import Tensor, float32, float64

from sparsestreet.ops.backend import TRITON_REMEDY, has_triton
from sparsestreet.ops.cpu.library import find_library, remedy

CHOICES = ("auto", "torch", "triton")


def takes_triton(backend: str, *tensors: Tensor) -> bool:
    """Whether the Triton kernel takes these tensors, all on one device; "auto" takes it where it runs.

    It runs for contiguous float32 tensors on a CUDA device, and on the CPU by Triton's interpreter. The results are the
    same but for rounding, so "auto" takes torch for all other tensors. Raises ValueError for an unknown name, or for
    "triton" and tensors it does not take, RuntimeError with the remedy if the package triton is not installed.
    """
    if backend not in CHOICES:
        raise ValueError(f"no backend {backend!r} of a fused step: choose one of {CHOICES}")
    if backend == "torch":
        return False
    fits = all(tensor.dtype == float32 and tensor.is_contiguous() for tensor in tensors)
    device = tensors[0].device
    if backend == "auto":
        return fits and device.type == "cuda" and has_triton()
    if not has_triton():
        raise RuntimeError(f"backend 'triton' needs the package triton: {TRITON_REMEDY}")
    if not fits:
        kinds = [(tensor.dtype, tensor.stride()) for tensor in tensors]
        raise ValueError(f"backend 'triton' takes contiguous float32 tensors, got {kinds}: use backend='torch'")
    if device.type != "cuda" and not _interpreting():
        raise ValueError(f"backend 'triton' needs tensors on a CUDA device, got {device}: use backend='torch'")
    return True


def fused_backend(backend: str, *tensors: Tensor) -> str:
    """Whether "torch" or the C++ library ("cpu") does a step; "auto" takes the library where it is built and fits.

    It takes tensors on the CPU that are all float32 or all float64. Raises ValueError for an unknown name, or for "cpu"
    and tensors it does not take, RuntimeError with the remedy if the library is not built.
    """
    if backend not in ("auto", "torch", "cpu"):
        raise ValueError(f"no backend {backend!r} of this step: choose one of ('auto', 'torch', 'cpu')")
    kinds = {(tensor.dtype, tensor.device.type) for tensor in tensors}
    fits = kinds in ({(float32, "cpu")}, {(float64, "cpu")})
    if backend != "cpu":
        return "cpu" if backend == "auto" and fits and find_library() is not None else "torch"
    if not fits:
        raise ValueError(f"backend 'cpu' takes float32 or float64 tensors on the CPU, got {kinds}: use backend='torch'")
    if find_library() is None:
        raise RuntimeError(f"backend 'cpu' needs the C++ library: {remedy()}")
    return "cpu"


def _interpreting() -> bool:
    from triton import knobs

    return knobs.runtime.interpret
