"""The lens of a camera. The op simulates it where a camera has one (``Camera.distortion``, docs/effects.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sparsestreet.geometry.lenses import largest_shift
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Camera, View

_NS_PER_ROW = 7.4
"""The projection of a Gaussian through a lens, less that of a pinhole (docs/effects.md)."""


@dataclass(frozen=True, kw_only=True)
class LensSettings(EffectSettings):
    """Called for where the lens of a camera moves pixels far enough; all cameras have theirs then. Learns nothing."""

    min_shift: float = 0.5
    """Pixels, of the images as they are read, by which some lens moves some pixel away from a pinhole's; 0: any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_shift >= 0:
            raise ValueError(f"min_shift must be pixels >= 0, got {self.min_shift}: to leave out lenses say when=off")

    def detect(self, data: TrainingData) -> Finding:
        log = data.log
        cameras = {view.camera_index: view.camera for view in log.views if view.camera.distortion is not None}
        shift = max(map(_shift, cameras.values()), default=0.0)
        moved = f", which moves pixels by up to {shift:.3g}" if cameras else ""
        return Finding(
            called_for=bool(cameras) and shift >= self.min_shift,
            reason=f"{len(cameras)} of {log.num_cameras} cameras of {log.name} have a lens{moved}",
            value=shift,
            unit="px",
            threshold=self.min_shift,
            declared=True,
            missing=None if cameras else "give the log their coefficients",
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(ns_per_row=_NS_PER_ROW, ms_per_frame=0.41)

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


def _shift(camera: Camera) -> float:
    """Pixels by which the lens moves some pixel of the camera's images."""
    assert camera.distortion is not None  # as those have that are asked
    return largest_shift(camera.intrinsics, camera.distortion, camera.width, camera.height)
