"""Steps of training with two implementations: plain torch for any device, and one fused Triton kernel."""

from torch import Tensor, float32

from sparsestreet.ops.backend import TRITON_REMEDY, has_triton

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


def _interpreting() -> bool:
    from triton import knobs

    return knobs.runtime.interpret
