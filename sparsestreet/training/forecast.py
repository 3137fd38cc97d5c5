"""What a training will need and what it cost: memory, seconds, curves."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch

from sparsestreet.data import frame_cache
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.frame_cache import to_device
from sparsestreet.data.lazy import spread
from sparsestreet.evaluation.evaluate import evaluate_frames, screen_image
from sparsestreet.evaluation.speed import Timing, peak_megabytes
from sparsestreet.phases import StageRecorder, clock_of
from sparsestreet.records.costs import stage_costs, step_costs, update_costs
from sparsestreet.records.curves import LOGGED, Logged, LoggedFile
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.rendering import render
from sparsestreet.training.losses import Photometric
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Frame

TRIALS = 6
"""Steps that are measured; the median counts, since the first one compiles and loads."""

GROWTH = 0.6
"""A step with n times the Gaussians takes n^GROWTH times as long: the pixels stay as many (docs/length.md)."""

GROWS_TO = 3.0
"""Times as many Gaussians as at the start, where no limit holds them."""

OPTIMIZER = 1.3
"""A step with its optimizer and statistics takes so many times as long as without (docs/length.md)."""

MOVED_VIEW = 0.5
"""A moved view takes so much of a step (docs/moved_views.md)."""

CLOSING_SECONDS = 3.0
"""For files and plots at the end."""


@dataclass(frozen=True)
class Forecast:
    """The seconds that a run has before it."""

    step: float
    """Of a training step at the present number of Gaussians."""
    growth: float
    """Of a step, as a factor, until no more Gaussians are added."""
    grown: float
    """Fraction of the run at which that is."""
    image: float
    """Of the evaluation of one image."""
    frame: float
    """Of the rendering of one image."""
    images: int
    """That evaluation looks at."""
    renders: int
    """That its clocks need."""

    def steps(self, seconds: float, progress: float) -> int:
        """How many steps fit into ``seconds`` from ``progress`` to the end of the run."""
        return int(seconds / (self.step * self._factor(progress)))

    def training(self, steps: int, progress: float) -> float:
        """Seconds of the steps from ``progress`` to the end of the run."""
        return steps * self.step * self._factor(progress)

    @property
    def evaluation(self) -> float:
        """Seconds of evaluation."""
        return self.images * self.image + self.renders * self.frame + CLOSING_SECONDS

    def _factor(self, progress: float) -> float:
        """Of the mean step from here on: Gaussians are added evenly until ``grown``."""
        if progress >= self.grown:
            return 1.0
        rising, level = self.grown - progress, 1 - self.grown
        return (rising * (1 + self.growth) / 2 + level * self.growth) / (1 - progress)


def growth_of(system: StreetSystem) -> float:
    """Times as long a step will take when every node is as large as it may get."""
    now = sum(system.scene.counts().values())
    return max(largest(system) / max(now, 1), 1.0) ** GROWTH


def largest(system: StreetSystem) -> int:
    """Gaussians that the scene may grow to; ``GROWS_TO`` times those of a node without a limit."""
    nodes = system.scene.nodes.values()
    limits = (
        len(node.rows) if node.settings.density is None else node.settings.max_gaussians or GROWS_TO * len(node.rows)
        for node in nodes
    )
    return int(sum(max(limit, len(node.rows)) for limit, node in zip(limits, nodes, strict=True)))


def size_in_words(system: StreetSystem) -> str:
    """The Gaussians that a run may end with: a limit, or a guess where a node that grows has none."""
    settings = [node.settings for node in system.scene.nodes.values()]
    if any(one.density is not None and one.max_gaussians is None for one in settings):
        return f"some {largest(system):,} Gaussians ({GROWS_TO:g} times those of now, as no limit holds them)"
    return f"at most {largest(system):,} Gaussians"


def measured_step(system: StreetSystem, data: StreetData) -> float:
    """Seconds of a training step. The loss is the photometric one, which counts and draws nothing: what is trained
    afterwards stays the same to the bit."""
    frames = data.split.train
    sample = [to_device(frame, system.device) for frame in frames.at(spread(len(frames), TRIALS))]
    moved = 0.0 if system.moved_views is None else MOVED_VIEW * system.moved_views.frequency
    bare = median(_seconds(lambda frame=frame: _step(system, frame), system.device) for frame in sample)
    return (OPTIMIZER + moved) * bare


def measured_evaluation(system: StreetSystem, data: StreetData) -> tuple[float, float]:
    """Seconds of the evaluation of one training image, and of one rendering."""
    frame = to_device(data.split.train[0], system.device)
    scene, training = system.scene, system.scene.training
    scene.eval()
    try:
        once = _seconds(lambda: list(evaluate_frames(scene, [frame], system.options)), system.device)
        return once, _seconds(lambda: screen_image(scene, frame, system.options), system.device)
    finally:
        scene.train(training)


def renders_of(timing: Timing, cameras: int, parts: int) -> int:
    """Render of ``evaluation.speed``: a splat, a frame and a rig each time, then rounds with and without each part."""
    return timing.warmup + timing.repeats * (2 + cameras) + timing.rounds * 2 * parts


def _step(system: StreetSystem, frame: Frame) -> None:
    rendering = render(system.scene, frame, system.state(), system.options)
    Photometric()(rendering, frame, system.scene).backward()
    system.zero_grad(set_to_none=True)


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    clock = clock_of(device)
    started = clock.mark()
    work()
    return clock.seconds(started, clock.mark())


log = logging.getLogger(__name__)

COPIES = 3
"""Of each column, always: values and Adam's two moments."""
ACTIVATED = 4 * 11
"""Bytes of a Gaussian as it is drawn, but its harmonics, which are read from their columns. Its gradient takes as
much."""
STATISTICS = 16 + 8
"""Bytes a Gaussian of density control, and of the gradient on screen that it reads."""
SCREEN = 4 * 12 + 2 * 4 + 3 * 4
"""Bytes a Gaussian and view, kept for the backward pass: its record, radius and tiles, and its place in the lists."""
SUMS = 4 * 12
"""Bytes a Gaussian of gradients on screen, summed over its pairs."""
PAIRS = 3.3
"""(Splat, tile) pairs of a Gaussian: of 5 million random ones at 1920x1280; those of a street have 1.4
(benchmarks/gpu.jsonl, gpu_street.jsonl)."""
PAIR, SLOT = 15.0, 4 * 12.0
"""Bytes of a pair in the lists, with the room that a view does not fill, and of its gradients."""
PIXEL_BYTES = 110
"""For each pixel of an image: layers, their gradients, the recorded image, SSIM and its derivatives."""
MARGIN = 0.1
"""Of what is free, left to others: allocators round, and images differ in what they need."""


def foreseen_bytes(rows: int, row_bytes: float, pixels: int, *, moved: bool = True) -> float:
    """Return what a training step needs on its device at once, in each process: all have all Gaussians.

    The most is held while gradients of splats become those of what is drawn, or these become those of columns.

    Args:
        rows: Gaussians.
        row_bytes: of the columns of one.
        pixels: of the largest image.
        moved: whether some steps render a second view (``training.moved_views``).

    >>> f"{foreseen_bytes(5_000_000, 236.0, 1920 * 1280) / 1e9:.1f} GB"
    '8.7 GB'
    """
    return rows * _bytes_a_row(row_bytes, moved) + PIXEL_BYTES * pixels


def _bytes_a_row(row_bytes: float, moved: bool) -> float:
    views = 2 if moved else 1
    held = COPIES * row_bytes + ACTIVATED + STATISTICS + views * (SCREEN + PAIRS * PAIR)
    of_splats = views * row_bytes + SUMS + PAIRS * SLOT  # of what is drawn, as many numbers as the columns have
    of_columns = ACTIVATED + row_bytes
    return held + max(of_splats, of_columns)


def memory_problem(
    now: int, grown: int, row_bytes: float, pixels: int, available: float, *, moved: bool = True
) -> str | None:
    """A warning where the scene may outgrow ``available`` bytes; None where it cannot.

    Raises ValueError where not even the Gaussians at the start fit.
    """
    needed = foreseen_bytes(grown, row_bytes, pixels, moved=moved)
    if needed <= available:
        return None
    start = foreseen_bytes(now, row_bytes, pixels, moved=moved)
    rows, needed = (now, start) if start > available else (grown, needed)
    said = (
        f"{rows:,} Gaussians and an image of {pixels:,} pixels need about {needed / 1e9:.1f} GB, and the device has "
        f"{available / 1e9:.1f} GB: lower max_gaussians of the largest nodes, or the size of the images. More "
        "processes do not help, since each holds all Gaussians"
    )
    if start > available:
        raise ValueError(said)
    return f"the scene may outgrow the device: {said}"


def bytes_of_row(rows: Rows, *, moved: bool = True) -> int:
    """Return what a step needs for one more Gaussian of a node; ``moved`` as in ``foreseen_bytes``."""
    columns = rows.columns().values()
    row_bytes = float(sum(column[:1].numel() * column.element_size() for column in columns))
    return round(_bytes_a_row(row_bytes, moved))


def bytes_for_growth(device: torch.device) -> float:
    """What Gaussians that are added now may take: of a GPU what a step has left at its peak so far, of the host what
    is free; infinite where a host does not say. Nothing waits."""
    if device.type == "cuda":
        free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
        return (1 - MARGIN) * (free - torch.cuda.max_memory_allocated(device))
    free = frame_cache.free_bytes()
    return float("inf") if free is None else (1 - MARGIN) * free


def report_memory(system: StreetSystem, data: StreetData) -> None:
    """Say what a GPU will have to hold. Raises ValueError where it cannot hold the start."""
    if system.device.type != "cuda":
        return
    columns = [column for node in system.scene.nodes.values() for column in node.rows.columns().values()]
    now = sum(system.scene.counts().values())
    row_bytes = sum(column.numel() * column.element_size() for column in columns) / max(now, 1)
    pixels = max(view.camera.width * view.camera.height for view in data.split.train.views)
    # What torch holds already will serve.
    available = torch.cuda.mem_get_info(system.device)[0] + torch.cuda.memory_reserved(system.device)
    moved = system.moved_views is not None
    if problem := memory_problem(now, largest(system), row_bytes, pixels, available, moved=moved):
        log.warning(problem)


def record_costs(out: Path, stages: StageRecorder, device: torch.device) -> None:
    """Write the seconds of every stage until now, the milliseconds of a step's parts, and the peaks of memory."""
    host, on_device = peak_megabytes(device)
    seconds = stages.seconds()
    phases, passes = stage_costs(seconds)
    update_costs(
        out,
        wall_seconds=sum(seconds.values()),
        phases=phases,
        passes=passes,
        step_ms=step_costs(out),
        peak_host_mb=host,
        peak_device_mb=on_device,
    )


EARLIER = LoggedFile("curves/earlier.csv")
"""What a run logged before it went on, while it goes on: another kill must not lose it."""


@contextmanager
def kept_curves(run: Path, resumed_at: int | None, of: Path | None = None) -> Iterator[None]:
    """While training goes on, keep what ``metrics.csv`` said of the steps before ``resumed_at``; None: a new run.

    ``of``: the run whose checkpoint it goes on from; None: this one.

    Lightning's CSV logger begins its file anew. What an earlier part logged behind the checkpoint is left out: those
    steps are taken again.
    """
    logged = [] if resumed_at is None else _joined(of or run)
    earlier = [row for row in logged if resumed_at is not None and int(row["step"]) < resumed_at]
    if earlier:
        EARLIER.write(run, earlier)
    try:
        yield
    finally:
        if earlier:
            LOGGED.write(run, _joined(run))
            EARLIER.remove(run)


def _joined(run: Path) -> list[Logged]:
    """The rows of both files; a kill may leave a row in both."""
    rows = [*EARLIER.rows(run), *LOGGED.rows(run)]
    return list({tuple(sorted((name, text) for name, text in row.items() if text)): row for row in rows}.values())
