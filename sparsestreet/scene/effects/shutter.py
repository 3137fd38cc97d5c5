"""The rolling shutter of a camera. The op simulates it where a camera has one (``Camera.shutter``, docs/effects.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sparsestreet.evidence.motion import readout_shear, shear_over
from sparsestreet.pictures.images import Places
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View

_NS_PER_ROW = 2.1
"""The motion of a Gaussian during the readout, beside its projection (docs/effects.md)."""


@dataclass(frozen=True, kw_only=True)
class ShutterSettings(EffectSettings):
    """Called for where what stands still is sheared while an image is read out. Nothing is learned."""

    min_shear: float = 1.0
    """Pixels, of the images as they are read, that static points cross during the readout (95th percentile)."""

    def detect(self, data: TrainingData) -> Finding:
        cameras = {view.camera_index for view in data.log.views if view.camera.shutter is not None}
        if not cameras:
            return Finding(
                called_for=False,
                reason=f"no camera of {data.log.name} declares how long its readout takes",
                threshold=self.min_shear,
                unit="px",
                declared=True,
                missing="read the log with a reader that knows how its cameras are read out",
            )
        found = readout_shear(data.frames.views, data.sweeps)
        return Finding(
            called_for=found.pixels >= self.min_shear,
            reason=(
                f"{len(cameras)} of {data.log.num_cameras} cameras declare a rolling shutter; 5 % of {found.points:,} "
                f"static points in {found.views} images move by {found.pixels:.2f} px or more while these are read out"
            ),
            value=found.pixels,
            unit="px",
            threshold=self.min_shear,
            noise=found.error,
            declared=True,
            evidence=partial(_shown, data),
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(ns_per_row=_NS_PER_ROW)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "RollingShutter":
        return RollingShutter(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "RollingShutter":
        return RollingShutter(self)

    def left_out(self) -> "GlobalShutter":
        return GlobalShutter(replace(self, when="off"))


def _shown(data: TrainingData) -> list[Places]:
    """The shear over an image of each camera with a shutter, in the middle of the drive."""
    panels = []
    for camera in sorted({view.indices[1] for view in data.views if view.camera.shutter is not None}):
        own = data.frames.where(lambda view, camera=camera: view.indices[1] == camera)
        frame = own[len(own) // 2]
        pixels, moved = shear_over(frame, data.sweeps)
        title = f"camera {camera}: what static points cross during the readout"
        panels.append(Places(title, frame.image.numpy(), pixels.numpy(), moved.numpy(), "px"))
    return panels


class RollingShutter(Effect):
    """The motion that the camera of a view has while its image is read."""


class GlobalShutter(Effect):
    """Stands for the rolling shutter that is left out: all pixels are exposed at once."""

    def view(self, view: View, state: SceneState) -> View:
        return view if view.camera.shutter is None else replace(view, camera=replace(view.camera, shutter=None))
