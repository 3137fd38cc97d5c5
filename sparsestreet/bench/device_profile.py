"""Time and memory on a CUDA device: of each stage and kernel, how often the host waits, the peak of a training step."""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import DeviceType, ProfilerActivity, profile

from sparsestreet.bench.timing import TimeSpread, spread

STAGES = {
    "blend_backward": r"(blend|raster).*(backward|bwd)",
    "project_backward": r"(project|spherical|quat_scale).*(backward|bwd)|slots",
    "project": r"project|spherical|quat_scale",
    "blend": r"blend|raster|_parts|^compose",
    "sort": r"(?<!search)sort|radix",
    "bin": r"list_|tile|pairs|isect|intersect|scan|search",
}
"""Stage -> pattern of its kernels' names, ours and gsplat 1.5.3's. The first match gets the time, the rest is
``other``."""
WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cuStreamSynchronize", "cuEventSynchronize", "cudaMemcpy")
"""Calls of the CUDA runtime and driver in which the host waits. Waits for the whole device are the measurement's."""


def stage_of(kernel: str) -> str:
    """The stage that a kernel's name belongs to."""
    return next((stage for stage, pattern in STAGES.items() if re.search(pattern, kernel.lower())), "other")


@dataclass(frozen=True)
class DeviceProfile:
    """What a run makes the device do, by repeats that are profiled one by one."""

    stages: dict[str, TimeSpread]
    """Device time of each stage. Copies and fills of memory are ``other``."""
    kernels: dict[str, TimeSpread]
    """Device time by name. Kernels of Triton that are launched again in a run are counted: "blend_tiles 2"."""
    launches: int
    """Kernels, copies and fills of a run."""
    waits: int
    """How often the host waits for the device in a run."""


def profiled(run: Callable[[], None], repeats: int = 7) -> DeviceProfile:
    """Profiles ``run``. A stage or kernel that is missing from a repeat counts as zero; counts are of the last one."""
    _events_of(run)  # does not count: the profiler starts, kernels are compiled
    taken = [_events_of(run) for _ in range(repeats)]
    kernels = [_kernels_of(events) for events in taken]
    waits = sum(event.device_type == DeviceType.CPU and event.name in WAITS for event in taken[-1])
    return DeviceProfile(
        _spreads([_summed(events, lambda events: [stage_of(event.name) for event in events]) for events in kernels]),
        _spreads([_summed(events, numbered) for events in kernels]),
        len(kernels[-1]),
        waits,
    )


def _events_of(run: Callable[[], None]) -> list[FunctionEvent]:
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiler:
        run()
        torch.cuda.synchronize()
    return list(profiler.events() or ())


def _kernels_of(events: list[FunctionEvent]) -> list[FunctionEvent]:
    """What ran on the device, in the order in which it began."""
    kernels = [event for event in events if event.device_type == DeviceType.CUDA]
    return sorted(kernels, key=lambda event: event.time_range.start)


def _summed(kernels: list[FunctionEvent], named: Callable[[list[FunctionEvent]], list[str]]) -> dict[str, float]:
    """Seconds by name."""
    seconds: dict[str, float] = {}
    for name, event in zip(named(kernels), kernels, strict=True):
        seconds[name] = seconds.get(name, 0.0) + 1e-6 * event.time_range.elapsed_us()
    return seconds


def numbered(kernels: list[FunctionEvent]) -> list[str]:
    """Short names. Triton's, which are plain words, have the number of their launch from the second on."""
    launches: Counter[str] = Counter()
    names = []
    for event in kernels:
        launches[event.name] += 1
        again = event.name.isidentifier() and launches[event.name] > 1
        names.append(f"{event.name} {launches[event.name]}" if again else short_name(event.name))
    return names


def short_name(kernel: str) -> str:
    """A kernel's name without its result, arguments and templates; of its namespaces the last.

    >>> short_name("void at_cuda_detail::cub::DeviceRadixSortOnesweepKernel<Policy<9, 1>, int>(int, int*)")
    'cub::DeviceRadixSortOnesweepKernel'
    >>> short_name("Memcpy DtoH (Device -> Pageable)")
    'Memcpy DtoH'
    """
    bare = kernel.replace("->", "")
    while bare != (bare := re.sub(r"<[^<>]*>|\([^()]*\)", "", bare)):
        pass
    words = bare.split() or [kernel]
    if "::" not in bare:
        return " ".join(words[1:] if words[0] == "void" else words)
    return "::".join([part for part in words[-1].split("::") if part][-2:])


def _spreads(taken: list[dict[str, float]]) -> dict[str, TimeSpread]:
    names = dict.fromkeys(name for seconds in taken for name in seconds)
    return {name: spread([seconds.get(name, 0.0) for seconds in taken]) for name in names}


def peak_megabytes(run: Callable[[], None]) -> tuple[float, float]:
    """Device memory before ``run`` and its peak during it, MB (10^6 bytes); what was there before counts in both."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    torch.cuda.synchronize()
    return 1e-6 * before, 1e-6 * torch.cuda.max_memory_allocated()
