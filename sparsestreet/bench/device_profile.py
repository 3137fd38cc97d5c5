"""Time and memory on a CUDA device: of each stage's kernels, and the peak of a training step."""

import re
from collections.abc import Callable

import torch
from torch.profiler import DeviceType, ProfilerActivity, profile

from sparsestreet.bench.timing import TimeSpread, spread

STAGES = {
    "blend_backward": r"(blend|raster).*(backward|bwd)",
    "project_backward": r"(project|spherical|quat_scale).*(backward|bwd)|slots",
    "project": r"project|spherical|quat_scale",
    "blend": r"blend|raster|_parts",
    "sort": r"(?<!search)sort|radix",
    "bin": r"list_|tile|pairs|isect|intersect|scan|search",
}
"""Stage -> pattern of its kernels' names, ours and gsplat 1.5.3's. The first match gets the time, the rest is
``other``."""


def stage_of(kernel: str) -> str:
    """The stage that a kernel's name belongs to."""
    return next((stage for stage, pattern in STAGES.items() if re.search(pattern, kernel.lower())), "other")


def kernel_milliseconds(run: Callable[[], None], repeats: int = 7) -> dict[str, TimeSpread]:
    """Device time of each stage in one ``run``, over repeats that are profiled one by one.

    Copies and fills of memory are ``other``. A stage that is missing from a repeat counts as zero."""
    _stages_of(run)  # does not count: the profiler starts, kernels are compiled
    taken = [_stages_of(run) for _ in range(repeats)]
    names = dict.fromkeys(name for stages in taken for name in stages)
    return {name: spread([stages.get(name, 0.0) for stages in taken]) for name in names}


def _stages_of(run: Callable[[], None]) -> dict[str, float]:
    """Seconds of each stage's kernels in one run."""
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        run()
        torch.cuda.synchronize()
    stages: dict[str, float] = {}
    for kernel in profiler.key_averages():
        if kernel.device_type == DeviceType.CUDA:
            stage = stage_of(kernel.key)
            stages[stage] = stages.get(stage, 0.0) + 1e-6 * kernel.self_device_time_total
    return stages


def peak_megabytes(run: Callable[[], None]) -> tuple[float, float]:
    """Device memory before ``run`` and its peak during it, MB (10^6 bytes); what was there before counts in both."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    torch.cuda.synchronize()
    return 1e-6 * before, 1e-6 * torch.cuda.max_memory_allocated()
