"""``sparsestreet bench step``: the time of each phase of a training step, compared with its floor.

A floor is the least memory traffic and arithmetic of a phase. Bytes count everything that must be read or written once,
in float32, without caches. Operations are those of the formula. A phase at its floor keeps memory or arithmetic units
busy all the time.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from lightning import Callback, Trainer
from matplotlib.figure import Figure
from torch.utils._python_dispatch import TorchDispatchMode

from sparsestreet.bench.figures import save_figure
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.timing import TimeSpread, spread
from sparsestreet.evaluation.speed import device_name, peak_megabytes
from sparsestreet.ops.ssim_window import WINDOW
from sparsestreet.phases import PhaseRecorder, clock_of
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.callbacks.times import LOOP
from sparsestreet.training.system import StreetSystem

FORWARD_FLOPS, BACKWARD_FLOPS = 36, 65
"""Operations per (splat, pixel) sample of one color blend, and of its gradient."""
NUMBER = 4.0
"""Bytes of a float32."""
_SHAPE_NUMBERS = 11
"""Numbers of a row's mean, quaternion, scales and opacity."""


@dataclass(frozen=True)
class Floor:
    """Bytes and floating point operations."""

    bytes: float
    flops: float = 0.0

    def seconds(self, bandwidth: float, peak: float) -> float:
        """Seconds at these bytes and operations per second: the larger of the two, as if they overlapped."""
        return max(self.bytes / bandwidth, self.flops / peak)


@dataclass(frozen=True)
class StepWork:
    """The work of one step."""

    rows: int
    visible: int
    """Rows that were drawn."""
    terms: int
    """Coefficients of the spherical harmonics in use."""
    samples: int | None
    """(splat, pixel) samples of the forward pass."""
    parameters: int
    """Numbers that the optimizer steps."""
    size: tuple[int, int]
    """Height and width."""
    sky_pixels: int

    @staticmethod
    def of(system: StreetSystem, rendering: SceneRendering, samples: int | None) -> "StepWork":
        """The work of the last step of the system, which made this rendering."""
        stepped = (value.numel() for value in system.scene.parameters() if value.grad is not None)
        degree = system.state().sh_degree
        seen = 1 - rendering.splats.alpha > system.options.settings.transmittance_min
        return StepWork(
            len(rendering.splats.radii),
            int(rendering.splats.visible.sum()),
            (min(degree, 3) + 1) ** 2,
            samples,
            sum(stepped),
            (rendering.alpha.shape[0], rendering.alpha.shape[1]),
            int(seen.sum()) if "sky" in system.scene.effects else 0,
        )


def floors(work: Sequence[StepWork]) -> dict[str, Floor]:
    """The floor of each phase, averaged over some steps; phases with a negligible floor are left out."""
    steps = [_floors(step) for step in work]
    return {
        name: Floor(mean(step[name].bytes for step in steps), mean(step[name].flops for step in steps))
        for name in (steps[0] if steps else ())
    }


def _floors(work: StepWork) -> dict[str, Floor]:
    pixels, color = work.size[0] * work.size[1], 3 * work.terms
    # Scales and opacity are read raw and written activated.
    assembly = Floor(NUMBER * 2 * work.rows * 4)
    read = work.rows * _SHAPE_NUMBERS + work.visible * color
    window_flops = 2 * 2 * WINDOW  # an 11-tap filter along two axes
    found = {
        "scene": assembly,
        "scene backward": assembly,
        "sky": Floor(NUMBER * (pixels + work.sky_pixels * (3 + 3))),
        "sky backward": Floor(NUMBER * work.sky_pixels * (3 + 1 + 3)),
        # Forward takes four means, of sums and differences; backward three derivatives.
        "loss photometric": Floor(NUMBER * 2 * 3 * pixels, 4.0 * window_flops * 3 * pixels),
        "ssim backward": Floor(NUMBER * 3 * 3 * pixels, 3.0 * window_flops * 3 * pixels),
        # Parameter, gradient and two moments are read, all but the gradient written.
        "optimizer": Floor(NUMBER * 7 * work.parameters),
        # Gradient and radius are read; three statistics read and written.
        "density statistics": Floor(NUMBER * work.rows * (3 + 2 * 4)),
    }
    if work.samples is not None:
        found["splat"] = Floor(NUMBER * read, float(FORWARD_FLOPS * work.samples))
        written = work.rows * (_SHAPE_NUMBERS + color + 2)
        found["splat backward"] = Floor(NUMBER * (read + written), float(BACKWARD_FLOPS * work.samples))
    return found


def measured_bandwidth(device: torch.device, megabytes: int = 256) -> float:
    """Bytes per second that an addition in place reads and writes, the best of several.

    It is in place because a copy also reads what it overwrites, which the count of bytes would miss.
    """
    values = torch.zeros(megabytes << 18, device=device)
    return 2 * NUMBER * values.numel() / _least_seconds(lambda: values.add_(1.0), device)


def measured_peak(device: torch.device, size: int = 2048) -> float:
    """float32 operations per second of a matrix product, the best of several."""
    a, b = torch.randn(size, size, device=device), torch.randn(size, size, device=device)
    return 2 * size**3 / _least_seconds(lambda: a @ b, device)


def _least_seconds(call: Callable[[], object], device: torch.device) -> float:
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


@dataclass(frozen=True)
class PhaseRecord:
    """One phase; a floor of None is unknown or negligible."""

    name: str
    time: TimeSpread
    operations: float
    """Dispatched tensor operations per step, without views."""
    floor: Floor | None
    floor_ms: float | None


@dataclass(frozen=True)
class StepRecord:
    """A training step, from the end of one batch to the end of the next; times are milliseconds."""

    what: str
    gaussians: dict[str, int]
    width: int
    height: int
    step: TimeSpread
    op: TimeSpread
    """The splat op, forward and backward."""
    operations: float
    bandwidth_gb_s: float
    peak_gflops: float
    phases: tuple[PhaseRecord, ...]
    device: str = "cpu"
    unwatched_ms: float | None = None
    """Wall clock of a step before the window, moved views included, where the host may run ahead of a device."""
    peak_device_mb: float | None = None
    """10^6 bytes that torch had allocated on a GPU at most until the end of the window; None on the CPU."""

    @property
    def ratio(self) -> float:
        """Time of the step divided by that of its op."""
        return self.step.median / self.op.median


_OP, _REST, _FLOOR = "#0072B2", "#E69F00", "#333333"


def draw_step(record: StepRecord, folder: Path) -> list[Path]:
    """Draw median milliseconds of each phase that takes at least a hundredth of the step, the longest on top."""
    shown = [phase for phase in record.phases if phase.time.median >= 0.01 * record.step.median]
    figure = Figure(figsize=(8.0, 1.3 + 0.34 * len(shown)), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    for place, phase in enumerate(shown):
        color = _OP if phase.name.startswith("splat") else _REST
        axes.barh(place, phase.time.median, color=color, height=0.72)
        if phase.floor_ms is not None:
            axes.barh(place, phase.floor_ms, color=_FLOOR, height=0.22)
        distance = "" if not phase.floor_ms else f", {phase.time.median / phase.floor_ms:.1f} x its floor"
        text = f" {phase.time.median:.1f} ms, {phase.operations:.0f} operations{distance}"
        axes.annotate(text, (phase.time.median, place), va="center", fontsize=8)
    axes.set_yticks(range(len(shown)), [phase.name for phase in shown])
    axes.invert_yaxis()
    axes.set_xlim(right=1.55 * max(phase.time.median for phase in shown))
    axes.set_xlabel("median milliseconds; black: floor (bytes over bandwidth, operations over peak)")
    axes.set_title(
        f"{record.what}: {record.step.median:.1f} ms a step, {record.ratio:.2f} x its op, "
        f"{record.operations:.0f} operations",
        fontsize=10,
    )
    axes.spines[["top", "right"]].set_visible(False)
    return save_figure(figure, folder, "step")


OP = ("splat", "splat backward")


@dataclass(frozen=True)
class StepWindow:
    """The steps of a run to measure: ``timed`` steps from ``first`` on, then ``counted`` steps."""

    first: int
    timed: int
    counted: int

    @property
    def last(self) -> int:
        return self.first + self.timed + self.counted


FULL, QUICK = StepWindow(740, 100, 10), StepWindow(10, 8, 4)


class StepWatch(Callback):
    """Times the phases of the steps in a window, then counts their operations, then ends training.

    Configure it last, because the work of other callbacks at the end of a step is part of the step.
    """

    _recorder: PhaseRecorder
    """Of the step that runs; there is one from the first step of the window on."""
    _mode: TorchDispatchMode
    """Counts what it does; there is one from the first counted step on."""

    def __init__(self, window: StepWindow) -> None:
        self.window = window
        self.seconds: list[dict[str, float]] = []
        self.work: list[StepWork] = []
        self.operations: Counter[str] = Counter()
        self.unwatched: float | None = None
        """Seconds of a step before the window, the mean of as many as are timed in it."""
        self.device = torch.device("cpu")
        """Where the steps run: when training has ended, Lightning takes the system back to the CPU."""
        self.peak_mb: float | None = None
        self._began: tuple[int, float] = (0, 0.0)
        """The step from which on unwatched ones count, and when it ended."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        step, window = trainer.global_step, self.window
        self.device = pl_module.device
        if step == max(window.first - window.timed, 1):
            self._began = step, time.perf_counter()
        if step == window.first > self._began[0] > 0:
            self.unwatched = (time.perf_counter() - self._began[1]) / (step - self._began[0])
        if step == window.first + window.timed:
            self.peak_mb = peak_megabytes(self.device)[1]
        if window.first < step <= window.first + window.timed:
            self.seconds.append(self._recorder.stop())
            if (rendering := pl_module.rendering) is not None:
                self.work.append(StepWork.of(pl_module, rendering, _samples(rendering)))
        if window.first + window.timed < step <= window.last:
            self._mode.__exit__(None, None, None)
            self._recorder.stop()
        if window.first <= step < window.last:
            self._recorder = PhaseRecorder(clock_of(pl_module.device), outside=LOOP)
            self._recorder.start()
            if step >= window.first + window.timed:
                self._mode = CountedOperations(self._recorder, self.operations)
                self._mode.__enter__()
        trainer.should_stop = trainer.should_stop or step >= window.last


class CountedOperations(TorchDispatchMode):
    """Counts dispatched operations by phase; views cost nothing and are left out."""

    def __init__(self, recorder: PhaseRecorder, counts: Counter[str]) -> None:
        super().__init__()
        self._recorder, self._counts = recorder, counts

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if not func.is_view:
            self._counts[self._recorder.current] += 1
        return func(*args, **(kwargs or {}))


def run_step(
    what: str,
    train: Callable[[Callback], StreetSystem],
    window: StepWindow,
    file: RecordFile,
    folder: Path,
    say: Callable[[str], None] = print,
) -> StepRecord:
    """Train through a window, write the record and draw it.

    Args:
        what: name of what is trained, in words.
        train: trains with one more callback, and returns what it trained.
        window: the steps to measure.
        file: file for the record.
        folder: folder for the picture.
        say: called with the lines of the table.
    """
    watch = StepWatch(window)
    system = train(watch)
    record = _record(what, system, watch)
    file.write("step", record)
    for line in lines(record):
        say(line)
    for path in draw_step(record, folder):
        say(f"drawn: {path}")
    return record


def _record(what: str, system: StreetSystem, watch: StepWatch) -> StepRecord:
    bandwidth, peak = measured_bandwidth(watch.device), measured_peak(watch.device)
    least = floors(watch.work)
    names = sorted(
        {name for seconds in watch.seconds for name in seconds} | watch.operations.keys(),
        key=lambda name: -_total(watch, name),
    )
    phases = []
    for name in names:
        floor = least.get(name)
        taken = spread([seconds.get(name, 0.0) for seconds in watch.seconds])
        floor_ms = None if floor is None else 1e3 * floor.seconds(bandwidth, peak)
        phases.append(PhaseRecord(name, taken, watch.operations[name] / watch.window.counted, floor, floor_ms))
    height, width = watch.work[-1].size
    return StepRecord(
        what,
        system.scene.counts(),
        width,
        height,
        spread([sum(seconds.values()) for seconds in watch.seconds]),
        spread([sum(seconds.get(name, 0.0) for name in OP) for seconds in watch.seconds]),
        sum(watch.operations.values()) / watch.window.counted,
        1e-9 * bandwidth,
        1e-9 * peak,
        tuple(phases),
        device_name(watch.device),
        None if watch.unwatched is None else 1e3 * watch.unwatched,
        watch.peak_mb,
    )


def _total(watch: StepWatch, name: str) -> float:
    return sum(seconds.get(name, 0.0) for seconds in watch.seconds)


def _samples(rendering: SceneRendering) -> int | None:
    """(splat, pixel) samples of a rendering whose graph is there, where the backend counts them."""
    nodes = [rendering.splats.rgb.grad_fn]
    while nodes:
        node = nodes.pop()
        if (lease := getattr(node, "lease", None)) is not None:
            return lease.workspace.sample_count()
        nodes += [] if node is None else [following for following, _ in node.next_functions]
    return None


def lines(record: StepRecord) -> list[str]:
    """The record as a table for the terminal."""
    counts = ", ".join(f"{name} {count:,}" for name, count in record.gaussians.items())
    text = [
        f"{record.what}: {counts}, {record.width}x{record.height}",
        f"{'phase':<22}{'ms':>8}{'iqr':>7}{'share':>7}{'operations':>12}{'least ms':>10}{'distance':>10}",
    ]
    for phase in record.phases:
        share = phase.time.median / record.step.median
        floor = "" if phase.floor_ms is None else f"{phase.floor_ms:10.2f}{phase.time.median / phase.floor_ms:9.1f}x"
        text.append(
            f"{phase.name:<22}{phase.time.median:8.2f}{phase.time.iqr or 0.0:7.2f}{100 * share:6.0f}%"
            f"{phase.operations:12.0f}{floor}"
        )
    unwatched = "" if record.unwatched_ms is None else f"; {record.unwatched_ms:.2f} ms unwatched, moved views included"
    memory = "" if record.peak_device_mb is None else f"; {record.peak_device_mb:,.0f} MB of the device"
    return [
        *text,
        f"a step {record.step}; {record.ratio:.2f} times its op {record.op}; {record.operations:.0f} operations",
        f"on {record.device}{unwatched}{memory}",
        f"floors: {record.bandwidth_gb_s:.0f} GB/s (addition in place), "
        f"{record.peak_gflops:.0f} GFLOP/s (float32 matrix product)",
    ]
