"""Times and peak memory of the splat op on a CUDA device, with gsplat in the same run."""

import math
import re
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Literal

import torch
from torch import Tensor
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import DeviceType, ProfilerActivity, profile

from benchmarks import gsplat_baseline
from benchmarks.streets import front_streets
from sparsestreet.bench.accuracy import Errors, agrees, answer, errors
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import BenchScene, Size, frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import (
    ONCE,
    Cotangent,
    Draw,
    TimeSpread,
    TimingBudget,
    drop_gradients,
    leaves,
    on_device,
    spread,
    time_once,
    work_of,
)
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.cpu.library import find_library
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.ops.ssim import ssim
from sparsestreet.phases import clock_of
from sparsestreet.scene.density import DensityStatistics
from sparsestreet.types import Camera, Gaussians


@dataclass(frozen=True)
class GpuRecord:
    """One renderer at one size. Times are milliseconds, memory is MB (10^6 bytes)."""

    renderer: str
    device: str
    scene: str
    rows: int
    width: int
    height: int
    pairs: int | None = None
    """(splat, tile) pairs."""
    samples: int | None = None
    """(splat, pixel) samples of the forward pass; None for gsplat."""
    failed: str | None = None
    """Why a measurement is missing; earlier measurements stay."""
    inference: TimeSpread | None = None
    """Forward without gradients."""
    forward: TimeSpread | None = None
    backward: TimeSpread | None = None
    step: TimeSpread | None = None
    """A whole step of training (TrainingStep)."""
    stages: dict[str, TimeSpread] | None = None
    """Device time by stage of the kernels of one forward and backward; None without a CUDA device."""
    kernels: dict[str, TimeSpread] | None = None
    """The same by name (profiled)."""
    launches: int | None = None
    """Kernels, copies and fills of one forward and backward, and how often the host waits in them."""
    waits: int | None = None
    memory_before: float | None = None
    memory_peak: float | None = None
    """Peak during one forward and backward, including what was there before: the Gaussians."""
    parity: Errors | None = None
    """For gsplat: against us. For us: against the C++ backend in float64, if it is built. None above TRUTH_ROWS."""
    agrees: bool | None = None

    @property
    def ok(self) -> bool:
        return self.failed is None and self.agrees is not False


def line(record: GpuRecord) -> str:
    """One row of the table: medians, and in parentheses the least."""
    start = f"{record.renderer:<23} {record.scene:<16}{record.rows:>9} {record.width}x{record.height:<6}"
    if record.forward is None or record.backward is None:
        return f"{start} FAILED: {record.failed}"
    inference = _short(record.inference) if record.inference else "-"
    text = f"{start} forward {_short(record.forward)}  backward {_short(record.backward)}  no grad {inference} ms"
    if record.step is not None:
        text += f"  step {_short(record.step)}"
    if record.pairs is not None:
        text += f"  {1e-6 * record.pairs:.2f} M pairs"
    if record.samples is not None:
        text += f", {1e-6 * record.samples:.0f} M samples"
    if record.memory_peak is not None:
        text += f"  peak {record.memory_peak:7.0f} MB"
    if record.waits is not None and record.launches is not None:
        text += f"  {record.launches} launches, {record.waits} waits"
    if record.stages:
        text += "  [" + ", ".join(f"{name} {_short(value)}" for name, value in record.stages.items()) + "]"
    if record.parity is not None:
        psnr = record.parity.image.psnr
        text += f"  {'agrees' if record.agrees else 'DISAGREES'}: {'equal' if psnr is None else f'{psnr:.1f} dB'}"
    return text + (f"  FAILED: {record.failed}" if record.failed else "")


def _short(value: TimeSpread) -> str:
    """Median and least: the host's noise moves the first by up to 0.9 ms between two rows of a process."""
    return f"{value.median:.3f}" + ("" if value.iqr is None else f" ({value.minimum:.3f})")


Seen = Callable[[], tuple[Tensor, Tensor]]
"""Absolute screen gradients [n, 2] and radii [n] of a rendering, after its backward pass."""
Render = Callable[[Gaussians], tuple[Tensor, Seen]]

SHARE = 0.2
"""Weight of D-SSIM in the loss (3DGS, eq. 7)."""


def our_render(camera: Camera, settings: SplatSettings, backend: str) -> Render:
    """Renders with the op of this project."""

    def render(gaussians: Gaussians) -> tuple[Tensor, Seen]:
        rendering = splat(gaussians, camera, settings=settings, backend=backend)
        return rendering.rgb, lambda: (rendering.screen_gradients, rendering.radii)

    return render


def their_render(module: ModuleType, camera: Camera, device: torch.device, mode: str) -> Render:
    """Renders with gsplat in one of its modes."""
    moved = on_device(camera, device)

    def render(gaussians: Gaussians) -> tuple[Tensor, Seen]:
        rgb, meta = gsplat_baseline.draw_for_training(module, gaussians, moved, mode)
        return rgb, lambda: gsplat_baseline.seen(meta, len(gaussians))

    return render


class TrainingStep:
    """Parameters of a scene with an optimizer, and one step on one target image.

    Args:
        start: the Gaussians that are trained, float32.
        camera: the view; its target is random.
        render: the renderer.
    """

    def __init__(self, start: Gaussians, camera: Camera, render: Render) -> None:
        g = start
        fields = (g.means, g.quaternions, g.scales.log(), g.opacities.clamp(1e-6, 1 - 1e-6).logit(), g.dense_sh())
        self.parameters = [field.detach().clone().requires_grad_() for field in fields]
        self.optimizer = torch.optim.Adam(self.parameters, lr=1e-6, eps=1e-15, fused=g.means.is_cuda)
        generator = torch.Generator().manual_seed(2)
        self.target = torch.rand(camera.height, camera.width, 3, generator=generator).to(g.means)
        self.statistics = DensityStatistics(len(g), g.means.device)
        self.camera, self.render = camera, render

    def __call__(self) -> None:
        means, quaternions, log_scales, logits, sh = self.parameters
        rgb, seen = self.render(Gaussians(means, quaternions, log_scales.exp(), logits.sigmoid(), sh))
        error = (1 - SHARE) * (rgb - self.target).abs().mean() + SHARE * (1 - ssim(rgb, self.target))
        error.backward()
        self.statistics.add(*seen(), self.camera.width, self.camera.height)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)


def step_time(start: Gaussians, camera: Camera, render: Render, budget: TimingBudget) -> TimeSpread:
    """Milliseconds of a step; each step waits for the device."""
    step, clock, seconds = TrainingStep(start, camera, render), clock_of(start.means.device), []

    def run() -> None:
        begin = clock.mark()
        step()
        seconds.append(clock.seconds(begin, clock.mark()))

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    return spread(seconds)


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


ROWS = (1_500_000, 500_000, 5_000_000, 100_000, 1_000)
"""Numbers of rows. The last is almost no work for a device, so it measures the host."""
IMAGES = ((1920, 1280), (960, 640))
"""Sizes of images. The first rows and image are the headline, so a time limit cuts off others."""
TRUTH_ROWS = 1_500_000
"""Most splats for which images and gradients are compared, with gsplat's and with float64 on the host.

The host takes seconds where the device takes milliseconds."""
BUDGET = TimingBudget(repeats=30, seconds=8.0, least=20)


@dataclass(frozen=True)
class Workload:
    """What is rendered at one size."""

    scene: str
    rows: Gaussians
    camera: Camera

    @staticmethod
    def random(size: Size, device: torch.device) -> "Workload":
        """Splats of 2 pixels in a frustum twice as wide as the view."""
        camera = frustum_camera(size.width, size.height)
        gaussians = frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16)
        return Workload("random frustum", leaves(gaussians, torch.float32, device), camera)

    @staticmethod
    def of(scene: BenchScene, device: torch.device) -> "Workload":
        return Workload(scene.source, leaves(scene.gaussians, torch.float32, device), scene.camera)

    @property
    def device(self) -> torch.device:
        return self.rows.means.device


Renderer = Literal["ours", "gsplat"]


@dataclass(frozen=True)
class Comparison:
    """Who is measured, and how."""

    backend: str
    """Of our op."""
    peer: ModuleType | None
    budget: TimingBudget
    first: Renderer = "ours"
    """Measured before the other at each size: caches, clocks and the allocator remember what ran last."""
    compares: bool = True
    """Whether images and gradients are compared, which takes longer than the times."""

    @property
    def settings(self) -> SplatSettings:
        """Of our op: those that match the peer."""
        return gsplat_baseline.settings_beside(self.peer)


def run_gpu(
    sizes: Sequence[Size],
    device: torch.device,
    budget: TimingBudget,
    file: RecordFile,
    say: Callable[[str], None] = print,
    streets: Sequence[BenchScene] = (),
    first: Renderer = "ours",
    compares: bool = True,
) -> bool:
    """Measures trained streets, then every size; returns False if a renderer failed or gsplat disagrees.

    A failure does not stop the other measurements. gsplat runs in both of its modes at first, then in the faster one.
        Each record is on disk as soon as it is measured. ``first`` and ``compares`` as ``Comparison`` has them.
    """
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu: these are no GPU timings"
    backend, found = resolve_backend("auto", device), gsplat_baseline.find_gsplat(device)
    say(f"{name}; backend {backend}; {found if isinstance(found, str) else 'gsplat ' + gsplat_baseline.version(found)}")
    if device.type == "cuda" and backend == "reference":
        say("nothing is measured: the dense reference would take hours at these sizes; install triton")
        return False
    records: list[GpuRecord] = []
    comparison = Comparison(backend, None if isinstance(found, str) else found, budget, first, compares)
    modes: Sequence[str] = gsplat_baseline.MODES
    for workload in _workloads(sizes, streets, device):
        theirs: list[GpuRecord] = []
        for record in _measure_all(workload, name, comparison, modes):
            file.write("gpu", record)
            say(line(record))
            records.append(record)
            theirs += [record] if record.renderer.startswith("gsplat") else []
        if len(theirs) > 1:
            modes = (min(zip(modes, theirs, strict=True), key=_milliseconds)[0],)
    good = sum(record.ok for record in records)
    say(f"{good} of {len(records)} measured and in agreement")
    return good == len(records)


def _workloads(sizes: Sequence[Size], streets: Sequence[BenchScene], device: torch.device) -> Iterator[Workload]:
    """Streets first: a time limit cuts off what comes last."""
    for street in streets:
        yield Workload.of(street, device)
    for size in sizes:
        yield Workload.random(size, device)


def _measure_all(workload: Workload, name: str, comparison: Comparison, modes: Sequence[str]) -> Iterator[GpuRecord]:
    camera = workload.camera
    blank = GpuRecord("", name, workload.scene, len(workload.rows), camera.width, camera.height)
    comparison = replace(comparison, compares=comparison.compares and len(workload.rows) <= TRUTH_ROWS)
    parts = [_measure_ours, *([] if comparison.peer is None else [_measure_theirs])]
    for part in parts if comparison.first == "ours" else parts[::-1]:
        yield from part(workload, blank, comparison, modes)


def _measure_ours(
    workload: Workload, blank: GpuRecord, comparison: Comparison, modes: Sequence[str]
) -> Iterator[GpuRecord]:
    backend, settings, budget = comparison.backend, comparison.settings, comparison.budget
    record = replace(blank, renderer=f"sparsestreet {backend}")
    record = measure(record, _ours(workload, settings, backend), workload, budget)
    record = _counted(record, workload, settings, backend)
    record = stepped(record, our_render(workload.camera, settings, backend), workload, budget)
    if comparison.compares and find_library() is not None:
        record = compared(record, partial(_against_truth, workload, settings, backend))
    yield record


def _measure_theirs(
    workload: Workload, blank: GpuRecord, comparison: Comparison, modes: Sequence[str]
) -> Iterator[GpuRecord]:
    peer, budget = comparison.peer, comparison.budget
    assert peer is not None, "asked for where there is one"
    for mode in modes:
        record = replace(blank, renderer=f"gsplat {gsplat_baseline.version(peer)} {mode}")
        record = _listed(measure(record, _theirs(workload, peer, mode), workload, budget), workload, peer)
        record = stepped(record, their_render(peer, workload.camera, workload.device, mode), workload, budget)
        if comparison.compares:
            agreement = partial(gsplat_baseline.parity, peer, workload.rows, workload.camera, comparison.backend)
            record = compared(record, agreement)
        yield record


def _milliseconds(measured: tuple[str, GpuRecord]) -> float:
    record = measured[1]
    if record.forward is None or record.backward is None:
        return math.inf
    return record.forward.median + record.backward.median


def _counted(record: GpuRecord, workload: Workload, settings: SplatSettings, backend: str) -> GpuRecord:
    if record.failed is not None:
        return record
    pairs, samples = work_of(workload.rows, workload.camera, settings, backend)
    return replace(record, pairs=pairs, samples=samples)


def _listed(record: GpuRecord, workload: Workload, peer: ModuleType) -> GpuRecord:
    if record.failed is not None:
        return record
    try:
        with torch.no_grad():
            pairs = gsplat_baseline.draw(peer, workload.rows, workload.camera, packed=False)[2]
    except Exception as error:  # a peer may raise anything
        return replace(record, failed=_reason(error))
    return replace(record, pairs=pairs)


def _ours(workload: Workload, settings: SplatSettings, backend: str) -> Draw:
    def draw(rows: Gaussians) -> tuple[Tensor, Tensor]:
        rendering = splat(rows, workload.camera, settings=settings, backend=backend)
        return rendering.rgb, rendering.alpha

    return draw


def _theirs(workload: Workload, peer: ModuleType, mode: str) -> Draw:
    camera = on_device(workload.camera, workload.device)
    return lambda rows: gsplat_baseline.draw(peer, rows, camera, packed=mode == "packed")[:2]


def measure(record: GpuRecord, draw: Draw, workload: Workload, budget: TimingBudget) -> GpuRecord:
    """Measures times, then memory, then stages. An error is recorded: it is a result of this renderer at this size."""
    cotangent = Cotangent.of(workload.camera, workload.rows.means)

    def step() -> None:
        cotangent.backward(*draw(workload.rows))
        drop_gradients(workload.rows)

    try:
        budget.warm_up(step)
        forward, backward = _times(draw, cotangent, workload, budget)
        record = replace(record, forward=forward, backward=backward, inference=_inference(draw, workload, budget))
        if workload.device.type == "cuda":
            before, peak = peak_megabytes(step)
            record = replace(record, memory_before=before, memory_peak=peak, **vars(profiled(step)))
    except Exception as error:  # a peer may raise anything
        return replace(record, failed=_reason(error))
    return record


def stepped(record: GpuRecord, render: Render, workload: Workload, budget: TimingBudget) -> GpuRecord:
    """The record with the time of a step of training, or with the reason why there is none."""
    try:
        step = step_time(workload.rows, workload.camera, render, budget)
    except Exception as error:  # a peer may raise anything
        return replace(record, failed=record.failed or _reason(error))
    return replace(record, step=step)


def compared(record: GpuRecord, compare: Callable[[], Errors]) -> GpuRecord:
    """The record with its differences, or with the reason why there are none."""
    try:
        difference = compare()
    except Exception as error:  # a peer may raise anything
        return replace(record, failed=record.failed or _reason(error))
    return replace(record, parity=difference, agrees=agrees(difference))


def _against_truth(workload: Workload, settings: SplatSettings, backend: str) -> Errors:
    """Errors of our op on the device against the C++ backend in float64."""
    kind = workload.device.type
    ours = answer(workload.rows, workload.camera, settings, backend, torch.float32, kind)
    return errors(ours, answer(workload.rows, workload.camera, settings, "cpu", torch.float64))


def _times(draw: Draw, cotangent: Cotangent, workload: Workload, budget: TimingBudget) -> tuple[TimeSpread, TimeSpread]:
    taken: list[dict[str, float]] = []
    budget.runs(lambda: taken.append(time_once(draw, cotangent, workload.rows)))
    forward, backward = (spread([times[part] for times in taken]) for part in ("forward", "backward"))
    return forward, backward


@torch.no_grad()
def _inference(draw: Draw, workload: Workload, budget: TimingBudget) -> TimeSpread:
    clock, seconds = clock_of(workload.device), []

    def run() -> None:
        start = clock.mark()
        draw(workload.rows)
        seconds.append(clock.seconds(start, clock.mark()))

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    return spread(seconds)


def _reason(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else 'no message'}"


USAGE = """\
python -m benchmarks.gpu [key=value ...]     a CUDA device at 0.1 to 5 M splats, beside it gsplat, if installed

  python -m benchmarks.gpu street=RUN                      and the street of a trained run, before them
  python -m benchmarks.gpu street=RUN enlarge=2 rows=1000  also in images twice as wide and high; few random splats
  python -m benchmarks.gpu street=scene.street refine=3    of nine splats for each, seen three times as large

  quick     true: tiny sizes and few repeats, also without a device: to see that it runs
  street    a run's folder, a .street or a scene.safetensors beside its views.json: its front camera, in two frames
  refine    how many times as large the street is seen, each splat cut into refine x refine (default: 1)
  enlarge   factor of the larger images (default: 1)
  rows      numbers of random splats (default: those of the tables in docs/gpu.md)
  first     ours or gsplat: which is measured first; call both, and believe what both say (default: ours)
  compares  false: images and gradients are not compared
  out       folder for gpu.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class GpuRequest:
    """The script's options. Raises ValueError where they are wrong."""

    quick: bool = False
    street: Path | None = None
    refine: int = 1
    enlarge: int = 1
    rows: tuple[int, ...] = ROWS
    first: Renderer = "ours"
    compares: bool = True
    out: Path = Path("outputs/bench")

    def __post_init__(self) -> None:
        if min(self.enlarge, self.refine) < 1 or (max(self.enlarge, self.refine) > 1 and self.street is None):
            raise ValueError(
                f"enlarge and refine show street=RUN at least 1 time as large, got {self.enlarge} and {self.refine}"
            )


def main(words: list[str]) -> int:
    """Measure as the words say; 0 if all renderers ran and agree."""
    good = []
    command = shlex.join(["python", "-m", "benchmarks.gpu", *words])

    def act(request: GpuRequest) -> None:
        good.append(_measured(request, command))

    return run_command("gpu", USAGE, words or ["quick=false"], GpuRequest, act) or int(not all(good))


def _measured(request: GpuRequest, command: str) -> bool:
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.type == "cpu" and not request.quick:
        raise ValueError("no CUDA device is available: quick=true runs it on the CPU, tiny")
    streets = [] if request.street is None else front_streets(request.street, request.enlarge, request.refine)
    sizes, budget = [Size(width, height, rows) for width, height in IMAGES for rows in request.rows], BUDGET
    if request.quick:
        sizes, budget = [Size(64, 48, 500)], ONCE
    file = record_file(request.out, "gpu", command)
    return run_gpu(sizes, device, budget, file, streets=streets, first=request.first, compares=request.compares)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
