"""Time and memory of a CUDA device: what each stage's kernels take, and the peak of a training step."""

import re
from collections.abc import Callable

import torch
from torch.profiler import DeviceType, ProfilerActivity, profile

STAGES = {
    "blend_backward": r"(blend|raster).*backward",
    "project_backward": r"project.*backward|slots",
    "project": r"project",
    "blend": r"blend|raster|_parts",
    "sort": r"sort|radix",
    "bin": r"list_|tile|pairs|isect|scan",
}
"""Stage -> pattern of its kernels' names; the first that fits gets the time, the rest is ``other``."""


def stage_of(kernel: str) -> str:
    """The stage that a kernel's name belongs to."""
    return next((stage for stage, pattern in STAGES.items() if re.search(pattern, kernel.lower())), "other")


def kernel_milliseconds(run: Callable[[], None], repeats: int = 5) -> dict[str, float]:
    """Mean milliseconds of device time of each stage in one ``run``, copies and fills of memory under ``other``."""
    run()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        for _ in range(repeats):
            run()
        torch.cuda.synchronize()
    stages: dict[str, float] = {}
    for kernel in profiler.key_averages():
        if kernel.device_type == DeviceType.CUDA:
            stage = stage_of(kernel.key)
            stages[stage] = stages.get(stage, 0.0) + 1e-3 * kernel.self_device_time_total / repeats
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
