"""Which implementations of the op there are, and which one runs on a device."""

import warnings

import torch

from sparsestreet.ops.cpu.library import find_library, remedy

BACKENDS = ("reference", "cpu")


def resolve_backend(name: str, device: torch.device) -> str:
    """``name`` if it can run on ``device``; for "auto" the fastest that can.

    Raises ValueError for an unknown name or a device the backend does not run on, RuntimeError with the remedy if the
    library of "cpu" is not built. "auto" without the library takes "reference" and warns once.
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
    if device.type == "cpu" and find_library() is not None:
        return "cpu"
    if device.type == "cpu":
        _warn_once(f"the C++ splat library is not built, so the dense reference renders, slowly: {remedy()}")
    else:
        _warn_once(f"no fast splat backend runs on {device}, so the dense reference renders, slowly: use the cpu")
    return "reference"


_warned: set[str] = set()


def _warn_once(message: str) -> None:
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, RuntimeWarning, stacklevel=4)
