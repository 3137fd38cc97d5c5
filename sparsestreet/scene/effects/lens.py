"""The lens of a camera. The op simulates it where a camera has one (``Camera.distortion``, docs/effects.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View

_NS_PER_ROW = 8.6
"""The projection of a Gaussian through a lens, less that of a pinhole (docs/effects.md)."""


@dataclass(frozen=True, kw_only=True)
class LensSettings(EffectSettings):
    """Called for where a view of the log has a lens. Nothing is learned."""

    def detect(self, data: TrainingData) -> Finding:
        cameras = {view.camera_index for view in data.log.views if view.camera.distortion is not None}
        return Finding(
            called_for=bool(cameras),
            reason=f"{len(cameras)} of {data.log.num_cameras} cameras of {data.log.name} have a lens",
            value=float(len(cameras)),
            unit="cameras",
            threshold=1.0,
            declared=True,
            missing=None if cameras else "give the log their coefficients or lower data.log.min_lens_shift",
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(ns_per_row=_NS_PER_ROW, ms_per_frame=0.5)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Lens":
        return Lens(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Lens":
        return Lens(self)

    def left_out(self) -> "Pinhole":
        return Pinhole(replace(self, when="off"))


class Lens(Effect):
    """The lens that the camera of a view has."""


class Pinhole(Effect):
    """Stands for the lens that is left out: every camera is a pinhole."""

    def view(self, view: View, state: SceneState) -> View:
        return view if view.camera.distortion is None else replace(view, camera=replace(view.camera, distortion=None))
