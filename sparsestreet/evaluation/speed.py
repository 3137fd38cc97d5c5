"""How long one image takes by three clocks: medians over many renders, with the device waited for."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sparsestreet.evaluation.scene_parts import has_masks, without_closed_rows
from sparsestreet.noise import calibrate, noise_between
from sparsestreet.ops import splat
from sparsestreet.records.provenance import processor_name
from sparsestreet.records.summary import FRAME, RASTER, RIG, Latency, Percentiles
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import View

T = TypeVar("T")

SceneAt = Callable[[View], SceneGraph]
"""The scene that is rendered for a view."""


@dataclass(frozen=True)
class Timing:
    """How often frames are timed. Raises ValueError for a number below 1."""

    warmup: int = 20
    """Renders that do not count, before those of ``measure_latency``."""
    repeats: int = 50
    """Renders of each of its clocks."""
    rounds: int = 25
    """Rounds of ``node_costs.measure_scene_costs``."""

    def __post_init__(self) -> None:
        if min(self.warmup, self.repeats, self.rounds) < 1:
            raise ValueError(f"timing needs at least one warm-up render, repeat and round, got {self}")


@torch.no_grad()
def measure_latency(
    scene: SceneGraph, views: Sequence[View], options: RenderOptions, *, warmup: int = 20, repeats: int = 50
) -> Latency:
    """Wall clock of rendering a view on the scene's device, milliseconds.

    The protocol, which the answer repeats in words: batch of one; ``warmup`` renders that are thrown away, then
    ``repeats`` timed ones, cycling through all ``views`` so that no easy view is singled out. Three clocks: "raster"
    is the splat op alone, "frame" all that a time and a pose need to become an image of uint8 on the device
    (assembling the scene at that time, projection, blending, effects, rounding) and neither loading nor metrics,
    "rig" the frames of all cameras of an instant, one after the other. On a CUDA device the clock waits for the device
    before and after. The median of "frame" is the headline: the mean of timings with a slow tail is several times
    noisier. A published number needs ``repeats`` >= 50. Frames per second are 1000 / p50, never the mean of 1 / t.

    Where masks close Gaussians at times, the clocks run once more with those taken out beforehand that are closed at
    the time of the view.

    Raises ValueError without views, or if ``warmup`` or ``repeats`` is below 1.
    """
    if not views or warmup < 1 or repeats < 1:
        raise ValueError(
            f"latency needs at least one view, warm-up and repeat, got {len(views)}, {warmup} and {repeats}"
        )
    before = calibrate(scene.device)
    rigs = instants(views)
    clocks = _Clocks(lambda view: scene, options, scene.device)
    kept = clocks.measure(_cycled(views, repeats), _cycled(rigs, repeats), warmup)
    removed = {}
    if has_masks(scene):
        times_of_a_rig = max(len({view.time for view in rig}) for rig in rigs)
        clocks = _Clocks(_WithoutClosedRows(scene, options, times_of_a_rig), options, scene.device)
        in_order = [view for rig in rigs for view in rig]
        removed = clocks.measure(_stretched(in_order, repeats), _stretched(rigs, repeats), warmup)
    noise = noise_between(before, calibrate(scene.device))
    return Latency(
        kept, removed, warmup, len(views), device_name(scene.device), threads=torch.get_num_threads(), noise=noise
    )


def frame_image(scene: SceneGraph, view: View, options: RenderOptions) -> UInt8[Tensor, "h w 3"]:
    """What the clock of a frame holds: from a time and a pose to what a screen takes, on the scene's device."""
    return to_uint8(render(scene, view, options=options).rgb)


def to_uint8(rgb: Float[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
    """Clamped and rounded."""
    return (rgb.clamp(0, 1) * 255).round().byte()


def instants(views: Sequence[View]) -> list[tuple[View, ...]]:
    """The recorded views of each instant, by their frame index and in its order: cameras fire at times of their own."""
    ordered = sorted(views, key=lambda view: view.indices[0])
    return [tuple(group) for _, group in groupby(ordered, key=lambda view: view.indices[0])]


def device_name(device: torch.device) -> str:
    """What a record calls a device, such as "cpu: Intel Xeon ..." or "cuda: NVIDIA H100"."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name()
    return f"{device.type}: {name}"


class _Clocks:
    """The three clocks on a scene that may depend on the view."""

    def __init__(self, scene_at: SceneAt, options: RenderOptions, device: torch.device) -> None:
        self._scene_at = scene_at
        self._options = options
        self._device = device

    def measure(self, frames: Sequence[View], rigs: Sequence[Sequence[View]], warmup: int) -> dict[str, Percentiles]:
        """Percentiles of as many turns as are given; ``warmup`` frames come first."""
        for index in range(warmup):
            self._frame(frames[index % len(frames)])
        return {
            FRAME: _percentiles([self._timed(lambda view=view: self._frame(view), [view]) for view in frames]),
            RIG: _percentiles([self._timed(lambda rig=rig: [self._frame(v) for v in rig], rig) for rig in rigs]),
            RASTER: _percentiles([self._timed(self._raster(view), [view]) for view in frames]),
        }

    def _frame(self, view: View) -> None:
        frame_image(self._scene_at(view), view, self._options)

    def _raster(self, view: View) -> Callable[[], object]:
        placed = self._scene_at(view).gaussians_at(view)
        settings, backend = self._options.settings, self._options.backend
        return lambda: splat(
            placed.gaussians, placed.view.camera, settings=settings, backend=backend, screen_gradients=False
        )

    def _timed(self, work: Callable[[], object], views: Sequence[View]) -> float:
        """Milliseconds of some work on the scenes of views, which are there before the clock starts."""
        for view in views:
            self._scene_at(view)
        _wait_for(self._device)
        start = time.perf_counter()
        work()
        _wait_for(self._device)
        return 1000 * (time.perf_counter() - start)


class _WithoutClosedRows:
    """The scene without the rows that are closed at the time of a view; it is drawn once whenever it is made.

    The last few are kept: as many as the views of an instant have different times.
    """

    def __init__(self, scene: SceneGraph, options: RenderOptions, kept: int) -> None:
        self._scene = scene
        self._options = options
        self._kept = kept
        self._made: dict[float, SceneGraph] = {}

    def __call__(self, view: View) -> SceneGraph:
        scene = self._made.pop(view.time, None)
        if scene is None:
            scene = without_closed_rows(self._scene, view.time)
            frame_image(scene, view, self._options)
        self._made[view.time] = scene
        if len(self._made) > self._kept:
            del self._made[next(iter(self._made))]
        return scene


def _cycled(items: Sequence[T], count: int) -> list[T]:
    return [items[index % len(items)] for index in range(count)]


def _stretched(items: Sequence[T], count: int) -> list[T]:
    """In order, equals beside each other: nothing has to be made twice."""
    return [items[index * len(items) // count] for index in range(count)]


def _percentiles(times: Sequence[float]) -> Percentiles:
    p50, p90, p99 = (float(value) for value in np.percentile(times, (50, 90, 99)))
    return Percentiles(p50, p90, p99, len(times))


def _wait_for(device: torch.device) -> None:
    """CUDA kernels run behind the host's back: without this the clock sees launches only."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
