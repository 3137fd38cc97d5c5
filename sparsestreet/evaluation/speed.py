"""What a scene costs where it is rendered: milliseconds of a frame, of each node and effect, and memory."""

import copy
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from operator import sub
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sparsestreet.noise import calibrate, noise_between
from sparsestreet.ops import splat
from sparsestreet.phases import PhaseRecorder, clock_of
from sparsestreet.records.costs import NodeCost
from sparsestreet.records.run import Noise, processor_name
from sparsestreet.records.summary import FRAME, RASTER, RIG, Latency, Percentiles
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Node
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import View


def has_masks(scene: SceneGraph) -> bool:
    """Whether any node still has a mask."""
    return any(node.mask is not None for node in scene.nodes.values())


def without_masks(scene: SceneGraph) -> SceneGraph:
    """The scene with every row shown at all times."""
    return scene.with_nodes({name: _unmasked(node) for name, node in scene.nodes.items()})


def without_closed_rows(scene: SceneGraph, time: float) -> SceneGraph:
    """The scene as it is at a normalized time, without the rows that masks close then, and without the masks."""
    nodes = {}
    for name, node in scene.nodes.items():
        nodes[name] = _unmasked(node)
        if node.mask is not None:
            nodes[name].rows.resize(RowPlan.keep(node.mask.multipliers(node.rows, time) > 0))
    return scene.with_nodes(nodes)


def _unmasked(node: Node) -> Node:
    if node.mask is None:
        return node
    bare = copy.deepcopy(node)
    bare.mask = None
    return bare


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
    """Rounds of ``measure_scene_costs``."""

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
        in_order = [view for rig in rigs for view in rig]
        view_at = {view.time: view for view in in_order}

        # As many are kept as the views of an instant have different times.
        @lru_cache(maxsize=max(len({view.time for view in rig}) for rig in rigs))
        def opened(time: float) -> SceneGraph:
            made = without_closed_rows(scene, time)
            frame_image(made, view_at[time], options)  # once whenever it is made
            return made

        clocks = _Clocks(lambda view: opened(view.time), options, scene.device)
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
        how = {"settings": self._options.settings, "backend": self._options.backend, "replay": self._options.replay}
        return lambda: splat(placed.gaussians, placed.view.camera, screen_gradients=False, **how)

    def _timed(self, work: Callable[[], object], views: Sequence[View]) -> float:
        """Milliseconds of some work on the scenes of views, which are there before the clock starts."""
        for view in views:
            self._scene_at(view)
        _wait_for(self._device)
        start = time.perf_counter()
        work()
        _wait_for(self._device)
        return 1000 * (time.perf_counter() - start)


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


OUTPUT = "output"
"""The part of a frame that is in no phase: what holds the others together, and uint8."""

MASKS = "masks"
"""All masks together, beside the effects of a scene."""

_WARMUP = 2
"""Rounds that do not count."""


@dataclass(frozen=True)
class SceneCosts:
    """Fields of ``CostRecord``, as far as a scene and views tell them."""

    frame_ms: dict[str, float]
    nodes: dict[str, NodeCost]
    effects: dict[str, float]
    noise: Noise


@torch.no_grad()
def measure_scene_costs(
    scene: SceneGraph, views: Sequence[View], options: RenderOptions, *, repeats: int = 30
) -> SceneCosts:
    """Leave-one-out costs on the scene's device, in frames as ``speed.measure_latency`` times them.

    Each of ``repeats`` rounds takes the next view and draws it whole and with one thing left out after the other, so
    that a machine that gets slower does so for all. Costs are medians over the rounds of whole less left out. A scene
    of one node is compared with one of no Gaussian.

    Raises ValueError without views, or if ``repeats`` is below 1.
    """
    if not views or repeats < 1:
        raise ValueError(f"costs need at least one view and one repeat, got {len(views)} and {repeats}")
    before = calibrate(scene.device)
    left_out = {name: scene.without(name) for name in scene.nodes}
    effects = {name: scene.without(name) for name, effect in scene.effects.items() if effect.is_on}
    if has_masks(scene):
        effects[MASKS] = without_masks(scene)
    rounds = _rounds({"": scene} | left_out | effects, views, options, repeats)
    frames = rounds.pop("")
    without = {name: [sum(parts.values()) for parts in times] for name, times in rounds.items()}
    whole = [sum(parts.values()) for parts in frames]
    costs = {name: statistics.median(map(sub, whole, times)) for name, times in without.items()}
    counts, sizes = scene.counts(), {name: node.row_bytes() + node.pose_bytes() for name, node in scene.nodes.items()}
    return SceneCosts(
        frame_ms={part: statistics.median(parts[part] for parts in frames) for part in frames[0]},
        nodes={
            name: NodeCost(counts[name], sizes[name] / 1e6, statistics.median(without[name]), costs[name])
            for name in left_out
        },
        effects={name: costs[name] for name in effects},
        noise=noise_between(before, calibrate(scene.device)),
    )


def _rounds(
    variants: Mapping[str, SceneGraph], views: Sequence[View], options: RenderOptions, repeats: int
) -> dict[str, list[dict[str, float]]]:
    """Variant -> part of a frame -> milliseconds, for each round."""
    times: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
    for index in range(-_WARMUP, repeats):
        view = views[index % len(views)]
        for name, variant in variants.items():
            parts = _frame_parts(variant, view, options)
            if index >= 0:
                times[name].append(parts)
    return times


def _frame_parts(scene: SceneGraph, view: View, options: RenderOptions) -> dict[str, float]:
    recorder = PhaseRecorder(clock_of(scene.device), outside=OUTPUT)
    recorder.start()
    frame_image(scene, view, options)
    return {name: 1e3 * seconds for name, seconds in recorder.stop().items()}


_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def forget_peaks() -> None:
    """Let the peaks start anew: a process may make several runs."""
    with suppress(OSError):  # not Linux, or not allowed: the peak is that of the process
        _FORGET.write_text("5")
    if torch.cuda.is_initialized():
        for device in range(torch.cuda.device_count()):
            torch.cuda.reset_peak_memory_stats(device)


def peak_megabytes(device: torch.device) -> tuple[float, float | None]:
    """10^6 bytes of the process on the host, and those that torch had allocated on a GPU (None on the CPU)."""
    on_device = torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None
    return _peak_of_the_host() * 1024 / 1e6, on_device


def _peak_of_the_host() -> int:
    """KiB. What ``forget_peaks`` resets is only in the status file."""
    if _STATUS.is_file():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
