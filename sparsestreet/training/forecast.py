"""What a run will cost in time, from a few steps that are measured before it starts."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.frame_cache import to_device
from sparsestreet.data.lazy import spread
from sparsestreet.evaluation.evaluate import evaluate_frames, screen_image
from sparsestreet.evaluation.speed import Timing
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
    """Renders of ``evaluation.speed``: a splat, a frame and a rig each time, then rounds with and without each part."""
    return timing.warmup + timing.repeats * (2 + cameras) + timing.rounds * 2 * parts


def _step(system: StreetSystem, frame: Frame) -> None:
    rendering = render(system.scene, frame, system.state(), system.options)
    Photometric()(rendering, frame, system.scene).backward()
    system.zero_grad(set_to_none=True)


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    _wait(device)
    started = time.perf_counter()
    work()
    _wait(device)
    return time.perf_counter() - started


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
