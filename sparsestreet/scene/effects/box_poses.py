"""Box poses: whether nodes of annotated objects learn corrections of the boxes that move them (``nodes.tracked``)."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.evidence.motion import box_jitter
from sparsestreet.geometry.boxes import displacement
from sparsestreet.scene.effects.effect import Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.nodes.tracked import Tracked

_MOVES = 0.5
"""Meters that an object must get before its boxes count: those of parked cars are often drawn once."""


@dataclass(frozen=True, kw_only=True)
class BoxPosesSettings(EffectSettings):
    """Called for where boxes of moving objects tremble. The rates of the corrections are those of the nodes.

    Raises ValueError for a negative threshold.
    """

    threshold: float = 2.0
    """Centimeters, standard deviation of a corner about its path (``evidence.boxes``)."""

    smooth: bool = True
    """Corrections start where boxes would lie on smooth paths (``geometry.smooth_paths``); false: at zero."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.threshold >= 0:
            raise ValueError(f"threshold must be >= 0 cm, got {self.threshold}")

    def detect(self, data: TrainingData) -> Finding:
        moving = [track for track in data.log.tracks if displacement(track) > _MOVES]
        found = box_jitter(moving, data.held_out)
        if found is None:
            # Two boxes tell no error from motion, and what boxes do at 2 frames a second is not known either.
            wanted, reason = bool(moving), f"{len(moving)} objects of {data.log.name} move, in too few boxes to tell"
            return Finding(called_for=wanted, reason=reason, unit="cm", threshold=self.threshold)
        value, objects = 100 * found.value, len(found.by_track)
        return Finding(
            called_for=value >= self.threshold,
            reason=f"corners of the boxes of {objects} moving objects lie {value:.1f} cm beside their paths",
            value=value,
            unit="cm",
            threshold=self.threshold,
            noise=None if math.isnan(found.error) else 100 * found.error,
        )

    def prepare(self, nodes: Iterable[Node], on: bool) -> None:
        for node in nodes:
            if isinstance(node, Tracked) and not on:
                node.fix_boxes()
            elif isinstance(node, Tracked) and self.smooth:
                node.smooth_boxes()

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> Effect | None:
        return None

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> Effect:
        raise ValueError(
            "box poses are parts of nodes, and no scene lists them among its effects: write the file again"
        )
