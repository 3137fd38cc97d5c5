"""The largest memory that a command had at once."""

import resource
from contextlib import suppress
from pathlib import Path

import torch

_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def forget_peaks() -> None:
    """Let the peaks start anew: a process may make several runs."""
    with suppress(OSError):  # not Linux, or not allowed: the peak is that of the process
        _FORGET.write_text("5")
    if torch.cuda.is_initialized():
        for device in range(torch.cuda.device_count()):
            torch.cuda.reset_peak_memory_stats(device)


def peak_megabytes(device: torch.device) -> tuple[float, float | None]:
    """10^6 bytes of the process on the host, and those that torch had allocated on a GPU (None on the CPU)."""
    on_device = torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None
    return _peak_of_the_host() * 1024 / 1e6, on_device


def _peak_of_the_host() -> int:
    """KiB. What ``forget_peaks`` resets is only in the status file."""
    if _STATUS.is_file():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
