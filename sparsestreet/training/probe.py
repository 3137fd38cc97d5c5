"""Two short trainings that decide about an effect whose measure alone does not: with it and without."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.kept import NOTHING
from sparsestreet.metrics.image import psnr_on_device
from sparsestreet.scene.build import build_scene
from sparsestreet.scene.effects import EffectPlan, ProbedGain
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import NodeSettings
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.losses import Loss, without_hood
from sparsestreet.training.optimizer import OptimizerSettings, set_rates
from sparsestreet.training.schedule import MIN_SIDE, smaller
from sparsestreet.types import Frame

_log = logging.getLogger(__name__)

STEPS = 300
"""Of each of the two trainings."""
EVERY = 8
"""Of so many training instants a probe holds one out."""
DIVISOR = 2
"""Of the sides of the images."""


@dataclass(frozen=True)
class Probe:
    """The parts of the two trainings: those of the run, without what changes the number of Gaussians.

    They train on the CPU, in one process, whatever the run does: their answer is the same wherever it is asked.
    """

    log: DrivingLog
    frames: Frames
    """The training views of the run; ``EVERY``-th instants of them are held out of the probe."""
    held_out: frozenset[int]
    """Integer frames that the run holds out."""
    nodes: Mapping[str, NodeSettings]
    losses: Mapping[str, Loss]
    optimizer: OptimizerSettings
    options: RenderOptions
    seed: int

    def kept_gain(self, plan: EffectPlan, name: str) -> ProbedGain | None:
        """Return ``gain``, from an earlier run on the same log, if one kept it."""
        on = [(one.name, one.settings, one.on) for one in plan.effects]
        said = self.nodes, self.losses, self.optimizer, self.options, self.seed, on
        return self.log.kept.get(f"probe-{name}", said, lambda: self.gain(plan, name), ProbedGain)

    def gain(self, plan: EffectPlan, name: str) -> ProbedGain | None:
        """Return by how much views that the probe holds out are better with an effect of a plan than without it.

        None where the drive has fewer than two instants to hold out.
        """
        if len(self._own_held_out) < 2:
            return None
        _log.info("effect %r is near its threshold: two trainings of %d steps decide", name, STEPS)
        with _in_silence():
            with_it, without = (self._psnr(plan.switched(name, on)) for on in (True, False))
        gains = with_it - without
        return ProbedGain(float(gains.mean()), float(gains.std() / len(gains) ** 0.5), len(gains))

    @cached_property
    def _own_held_out(self) -> frozenset[int]:
        instants = sorted({view.indices[0] for view in self.frames.views})
        return frozenset(instants[EVERY // 2 : -1 : EVERY])

    @cached_property
    def _options(self) -> RenderOptions:
        """Those of the run, but for a backend that may not draw on a CPU."""
        return replace(self.options, backend="auto")

    def _psnr(self, plan: EffectPlan) -> Float[Tensor, " n"]:
        """Train the scene of a plan; return the quality of each held-out image."""
        own = self._own_held_out
        seen, unseen = (
            [self._small(frame) for frame in self.frames.where(lambda view, out=out: (view.indices[0] in own) is out)]
            for out in (False, True)
        )
        train = self.frames.where(lambda view: view.indices[0] not in own)
        # What it measures is of fewer images than the run has: none of it may be kept for the run.
        alone = replace(self.log, kept=NOTHING)
        scene = build_scene(alone, train, self.held_out | own, self.nodes, plan, self.seed)
        self._train(scene, seen)
        with torch.no_grad():
            return torch.stack([self._quality(scene, frame) for frame in unseen])

    def _small(self, frame: Frame) -> Frame:
        side = min(frame.camera.width, frame.camera.height)
        return smaller(frame, max(min(DIVISOR, side // MIN_SIDE), 1))

    def _train(self, scene: SceneGraph, frames: list[Frame]) -> None:
        optimizer = self.optimizer.build(scene, self.log.radius)
        generator = torch.Generator().manual_seed(self.seed)
        order: list[int] = []
        for step in range(STEPS):
            order = order or torch.randperm(len(frames), generator=generator).tolist()
            frame = frames[order.pop()]
            state = SceneState(step / STEPS, 0, step=step)
            rendering = render(scene, frame, state, self._options)
            seen, recorded = without_hood(rendering, frame)
            terms = [loss(seen, recorded, scene) for loss in self.losses.values() if loss.applies(frame)]
            terms += scene.regularizers(frame, rendering.parts, rendering.drawn, state).values()
            set_rates(optimizer, state.progress)
            torch.stack(terms).sum().backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def _quality(self, scene: SceneGraph, frame: Frame) -> Float[Tensor, ""]:
        rendering, recorded = without_hood(render(scene, frame, SceneState(1.0, 0), self._options), frame)
        return psnr_on_device(rendering.rgb.clamp(0, 1), recorded.image.to(rendering.rgb.dtype) / 255)


@contextmanager
def _in_silence() -> Iterator[None]:
    """What a probe builds is no news: the run says the same of its own scene."""
    logger = logging.getLogger("sparsestreet")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
