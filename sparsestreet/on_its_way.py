"""Numbers that a device is about to compute, on their way to the host, which goes on at once."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class OnItsWay:
    """Numbers whose copy to the host may still be under way."""

    values: torch.Tensor
    done: torch.cuda.Event | None
    """None: they are there."""

    @property
    def is_there(self) -> bool:
        return self.done is None or self.done.query()

    def arrived(self) -> torch.Tensor:
        """The numbers on the host, which waits for them if it must."""
        if self.done is not None:
            self.done.synchronize()
        return self.values


def on_its_way(values: torch.Tensor) -> OnItsWay:
    """A copy on the host, of the values' shape, behind what their device has been told to do.

    >>> on_its_way(torch.ones(2)).arrived().tolist()
    [1.0, 1.0]
    """
    if values.device.type != "cuda":
        return OnItsWay(values.cpu(), None)
    # Memory of the host that the device can write while the host goes on.
    copy = torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
    done = torch.cuda.Event()
    done.record(torch.cuda.current_stream(values.device))
    return OnItsWay(copy, done)
