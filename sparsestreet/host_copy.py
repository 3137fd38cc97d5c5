"""Numbers that a device is about to compute, on their way to the host, which goes on at once."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class HostCopy:
    """Numbers whose copy to the host may still be under way."""

    values: torch.Tensor
    done: torch.cuda.Event | None
    """None: they are there."""

    @property
    def ready(self) -> bool:
        return self.done is None or self.done.query()

    def wait(self) -> torch.Tensor:
        """The numbers on the host, which waits for them if it must."""
        if self.done is not None:
            self.done.synchronize()
        return self.values


def copy_to_host(values: torch.Tensor) -> HostCopy:
    """A copy on the host, of the values' shape, behind what their device has been told to do.

    >>> copy_to_host(torch.ones(2)).wait().tolist()
    [1.0, 1.0]
    """
    if values.device.type != "cuda":
        return HostCopy(values.cpu(), None)
    # Memory of the host that the device can write while the host goes on.
    copy = torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
    done = torch.cuda.Event()
    done.record(torch.cuda.current_stream(values.device))
    return HostCopy(copy, done)
