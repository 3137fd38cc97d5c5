"""Time and memory of a CUDA device: what each stage's kernels take, and the peak of a training step."""

from collections.abc import Callable

import torch
from torch.profiler import DeviceType, ProfilerActivity, profile

STAGES = {
    "project_backward": ("project_backward", "projection_backward", "reduce_slots", "gather_slots"),
    "blend_backward": ("blend_backward", "raster_backward", "rasterize_backward"),
    "project": ("project", "colour"),
    "blend": ("blend", "raster"),
    "bin": ("tile", "emit", "count", "pairs"),
    "sort": ("sort", "radix"),
    "contribution": ("contribution",),
}
"""Stage -> parts of the names of its kernels; the first stage that fits gets the time, the rest is ``other``."""


def stage_of(kernel: str) -> str:
    """The stage that a kernel's name belongs to."""
    lowered = kernel.lower()
    return next((stage for stage, parts in STAGES.items() if any(part in lowered for part in parts)), "other")


def kernel_milliseconds(run: Callable[[], None], repeats: int = 5) -> dict[str, float]:
    """Mean milliseconds of device time of each stage in one ``run``, copies and fills of memory under ``other``."""
    run()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        for _ in range(repeats):
            run()
        torch.cuda.synchronize()
    stages: dict[str, float] = {}
    for event in profiler.events():
        if event.device_type == DeviceType.CUDA:
            stage = stage_of(event.name)
            stages[stage] = stages.get(stage, 0.0) + 1e-3 * event.device_time_total / repeats
    return stages


def peak_megabytes(run: Callable[[], None]) -> tuple[float, float]:
    """Device memory before ``run`` and the most during it, MB (10^6 bytes); what lay there counts in both."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    torch.cuda.synchronize()
    return 1e-6 * before, 1e-6 * torch.cuda.max_memory_allocated()
