"""The device that a command asks for."""

import torch


def device_of(name: str, asker: str, remedy: str) -> torch.device:
    """The device by name: cpu, cuda, or a GPU by its number, as cuda:1.

    Raises ValueError for any other name, and where torch sees no GPU: what needs one (``asker``) and what would help.
    """
    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {name!r}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"{asker} needs a CUDA device and torch sees none: {remedy}")
    return torch.device(name)
