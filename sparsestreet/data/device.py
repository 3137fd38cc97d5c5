"""Values from one device to another, for which the host does not wait.

Cameras stay on the host: the op and the rays read their numbers there.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch

from sparsestreet.types import Camera, Frame

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


@dataclass(frozen=True)
class Arriving:
    """A frame whose copy to a GPU may still be under way."""

    frame: Frame
    done: torch.cuda.Event

    def arrived(self) -> Frame:
        """The frame, for work that the current stream of its device is given from now on. The host does not wait."""
        stream = torch.cuda.current_stream(self.frame.image.device)
        stream.wait_event(self.done)
        for tensor in _tensors(self.frame):
            # Its memory belongs to the stream that copied it, and is not to be reused before this one is done.
            tensor.record_stream(stream)
        return self.frame


class CopyStream:
    """Copies frames to a GPU on a stream of its own, so that they travel while a step computes."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)

    def send(self, frame: Frame) -> Arriving:
        """Any thread may call it, and waits for the pinned copy on the host alone."""
        done = torch.cuda.Event()
        with torch.cuda.stream(self._stream):
            moved = to_device(frame, self._device)
            done.record(self._stream)
        return Arriving(moved, done)


def _tensors(frame: Frame) -> Iterator[torch.Tensor]:
    values = (getattr(frame, field.name) for field in fields(frame))
    return (value for value in values if isinstance(value, torch.Tensor))
