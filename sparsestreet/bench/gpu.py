"""``sparsestreet bench gpu``: stage times and peak memory at sizes of real scenes, with gsplat in the same run."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType

import torch
from torch import Tensor

from sparsestreet.bench import gsplat_peer
from sparsestreet.bench.accuracy import Errors, answer, errors
from sparsestreet.bench.device_profile import peak_megabytes, profiled
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.gpu_record import GpuRecord, line
from sparsestreet.bench.gpu_step import Render, our_render, step_time, their_render
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import BenchScene, Size
from sparsestreet.bench.tile_loads import loads_of
from sparsestreet.bench.timing import (
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
from sparsestreet.ops.backend import resolve_backend
from sparsestreet.ops.cpu.library import find_library
from sparsestreet.ops.splat import splat
from sparsestreet.ops.triton.tuning import Tuning, tuned
from sparsestreet.phases import clock_of
from sparsestreet.types import Camera, Gaussians

DEFAULT = {"": Tuning()}
"""The kernels as they are chosen without a word."""
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


def run_gpu(
    sizes: Sequence[Size],
    device: torch.device,
    budget: TimingBudget,
    file: RecordFile,
    say: Callable[[str], None] = print,
    streets: Sequence[BenchScene] = (),
    tunings: Mapping[str, Tuning] = DEFAULT,
) -> bool:
    """Measures every size, and trained streets after the first; returns False if a renderer failed or gsplat
    disagrees.

    ``tunings``, by their names in the table, are compared at every size. A failure does not stop the other
    measurements. gsplat runs in both of its modes at the first size, then in the
    faster one. Each record is on disk as soon as it is measured.
    """
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu: these are no GPU timings"
    backend, found = resolve_backend("auto", device), gsplat_peer.find_gsplat(device)
    say(f"{name}; backend {backend}; {found if isinstance(found, str) else 'gsplat ' + gsplat_peer.version(found)}")
    if device.type == "cuda" and backend == "reference":
        say("nothing is measured: the dense reference would take hours at these sizes; install triton")
        return False
    records: list[GpuRecord] = []
    peer, modes = (None, ()) if isinstance(found, str) else (found, gsplat_peer.MODES)
    for workload in _workloads(sizes, streets, device):
        for record in _measure_all(workload, name, backend, tunings, peer, modes, budget):
            file.write("gpu", record)
            say(line(record))
            records.append(record)
        if len(modes) > 1:
            modes = (min(zip(modes, records[-len(modes) :], strict=True), key=_milliseconds)[0],)
    good = sum(record.ok for record in records)
    say(f"{good} of {len(records)} measured and in agreement")
    return good == len(records)


def _workloads(sizes: Sequence[Size], streets: Sequence[BenchScene], device: torch.device) -> Iterator[Workload]:
    for size in sizes[:1]:
        yield Workload.random(size, device)
    for street in streets:
        yield Workload.of(street, device)
    for size in sizes[1:]:
        yield Workload.random(size, device)


def _measure_all(
    workload: Workload,
    name: str,
    backend: str,
    tunings: Mapping[str, Tuning],
    peer: ModuleType | None,
    modes: Sequence[str],
    budget: TimingBudget,
) -> Iterator[GpuRecord]:
    rows, camera = workload.rows, workload.camera
    blank = GpuRecord("", name, workload.scene, len(rows), camera.width, camera.height)
    is_compared = len(rows) <= TRUTH_ROWS
    for words, choices in tunings.items():
        record = replace(blank, renderer=" ".join(["sparsestreet", backend, *words.split()]), tuning=vars(choices))
        with tuned(choices):
            record = _counted(measure(record, _ours(workload, backend), workload, budget), workload, backend)
            record = stepped(record, our_render(camera, backend), workload, budget)
            if is_compared and find_library() is not None:
                record = compared(record, partial(_against_truth, workload, backend))
        yield record
    if peer is None:
        return
    for mode in modes:
        record = replace(blank, renderer=f"gsplat {gsplat_peer.version(peer)} {mode}")
        record = _listed(measure(record, _theirs(workload, peer, mode), workload, budget), workload, peer)
        record = stepped(record, their_render(peer, camera, workload.device, mode), workload, budget)
        if is_compared:
            record = compared(record, partial(gsplat_peer.parity, peer, workload.rows, workload.camera, backend))
        yield record


def _milliseconds(measured: tuple[str, GpuRecord]) -> float:
    record = measured[1]
    if record.forward is None or record.backward is None:
        return math.inf
    return record.forward.median + record.backward.median


def _counted(record: GpuRecord, workload: Workload, backend: str) -> GpuRecord:
    if record.failed is not None:
        return record
    given = (workload.rows, workload.camera, gsplat_peer.SETTINGS, backend)
    pairs, samples = work_of(*given)
    return replace(record, pairs=pairs, samples=samples, tiles=loads_of(*given))


def _listed(record: GpuRecord, workload: Workload, peer: ModuleType) -> GpuRecord:
    if record.failed is not None:
        return record
    try:
        pairs, tiles = gsplat_peer.loads_of(peer, workload.rows, workload.camera)
    except Exception as error:  # a peer may raise anything
        return replace(record, failed=_reason(error))
    return replace(record, pairs=pairs, tiles=tiles)


def _ours(workload: Workload, backend: str) -> Draw:
    def draw(rows: Gaussians) -> tuple[Tensor, Tensor]:
        rendering = splat(rows, workload.camera, settings=gsplat_peer.SETTINGS, backend=backend)
        return rendering.rgb, rendering.alpha

    return draw


def _theirs(workload: Workload, peer: ModuleType, mode: str) -> Draw:
    camera = on_device(workload.camera, workload.device)
    return lambda rows: gsplat_peer.draw(peer, rows, camera, packed=mode == "packed")[:2]


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
    return replace(record, parity=difference, agrees=gsplat_peer.agrees(difference))


def _against_truth(workload: Workload, backend: str) -> Errors:
    """Errors of our op on the device against the C++ backend in float64."""
    settings, kind = gsplat_peer.SETTINGS, workload.device.type
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
