"""Values from one device to another, for which the host does not wait.

Cameras stay on the host: the op and the rays read their numbers there.
"""

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch

from sparsestreet.types import Camera

T = TypeVar("T")


def to_device(value: T, device: torch.device) -> T:
    """A copy of a frozen dataclass with all tensors, nested ones too, on the device; those of a camera stay.

    The host does not wait for the copies to a GPU: they go through pinned memory.
    """
    return _moved(value, device)


def _moved(value: Any, device: torch.device) -> Any:
    if isinstance(value, torch.Tensor):
        pinned = value.pin_memory() if device.type == "cuda" and value.device.type == "cpu" else value
        return pinned.to(device, non_blocking=True)
    if isinstance(value, Camera) or not is_dataclass(value) or isinstance(value, type):
        return value
    return replace(value, **{field.name: _moved(getattr(value, field.name), device) for field in fields(value)})
