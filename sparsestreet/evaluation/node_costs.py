"""What each node class and each effect costs of a frame: the same frames with and without it, side by side."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import sub

import torch

from sparsestreet.evaluation.scene_parts import has_masks, without_masks
from sparsestreet.evaluation.speed import frame_image
from sparsestreet.noise import calibrate, noise_between
from sparsestreet.phases import PhaseRecorder, clock_of
from sparsestreet.records.costs import NodeCost
from sparsestreet.records.run import Noise
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import View

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
