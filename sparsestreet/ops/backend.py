"""The backends of the op, and which one runs on a device."""

import importlib.util
import warnings

import torch

from sparsestreet.ops.cpu.library import find_library, remedy

BACKENDS = ("reference", "cpu", "triton")
TRITON_REMEDY = "pip install 'sparsestreet[gpu]' (Linux)"


def resolve_backend(name: str, device: torch.device) -> str:
    """Returns ``name`` if it can run on ``device``, or for "auto" the fastest backend that can.

    "auto" takes "triton" on CUDA devices and "cpu" on the CPU; if they are missing, it takes "reference" and warns
    once.
    Raises ValueError for an unknown name or a device the backend does not run on. Raises RuntimeError with the remedy
    if
    the library of "cpu" is not built, or the package triton is not installed.

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
