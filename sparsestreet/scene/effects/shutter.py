"""The rolling shutter of a camera. The op simulates it where a camera has one (``Camera.shutter``, docs/effects.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sparsestreet.scene.effects.effect import Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


@dataclass(frozen=True, kw_only=True)
class ShutterSettings(EffectSettings):
    """Called for where a view of the log has a rolling shutter. Nothing is learned."""

    def detect(self, data: TrainingData) -> Finding:
        cameras = {view.camera_index for view in data.log.views if view.camera.shutter is not None}
        return Finding(
            called_for=bool(cameras),
            reason=f"{len(cameras)} of {data.log.num_cameras} cameras of {data.log.name} have a rolling shutter",
            value=float(len(cameras)),
            unit="cameras",
            threshold=1.0,
            declared=True,
            missing=None if cameras else "read the log with a reader that knows how long its cameras take for an image",
        )

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "RollingShutter":
        return RollingShutter(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "RollingShutter":
        return RollingShutter(self)

    def left_out(self) -> "GlobalShutter":
        return GlobalShutter(replace(self, when="off"))


class RollingShutter(Effect):
    """The motion that the camera of a view has while its image is read."""


class GlobalShutter(Effect):
    """Stands for the rolling shutter that is left out: all pixels are exposed at once."""

    def view(self, view: View, state: SceneState) -> View:
        return view if view.camera.shutter is None else replace(view, camera=replace(view.camera, shutter=None))
