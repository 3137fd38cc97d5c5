"""What a camera's optics do: the lens's distortion, the shutter's readout, and motion during the exposure."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.evidence.motion import blur_length, exposure_motions, readout_shear, shear_over
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import largest_shift
from sparsestreet.pictures.images import Places
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Exposed, Finding, Moment
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Camera, Shutter, View

_LENS_NS_PER_ROW = 7.4
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
        return Cost(ns_per_row=_LENS_NS_PER_ROW, ms_per_frame=0.41)

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


_SHUTTER_NS_PER_ROW = 2.1
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
        return Cost(ns_per_row=_SHUTTER_NS_PER_ROW)

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


MAX_MOMENTS = 5
_PIXELS_A_MOMENT = 3.0
"""A longer blur gets one moment more for each (docs/effects.md)."""
_BLUR_NS_PER_ROW, _BLUR_NS_PER_PIXEL = 84.0, 134.0
"""What splats, sky and light of a further moment take (docs/effects.md)."""


@dataclass(frozen=True, kw_only=True)
class MotionBlurSettings(EffectSettings):
    """Called for where what stands still moves far enough during the declared exposure. Nothing is learned."""

    when: Literal["auto", "on", "off"] = "off"
    found_when_off: ClassVar[bool] = True
    min_blur: float = 3.0
    """Pixels, of the images as they are read, that a tenth of the static points move during the exposure, or more."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_blur > 0:
            raise ValueError(f"min_blur must be pixels > 0, got {self.min_blur}: to blur any image say when=on")

    def detect(self, data: TrainingData) -> Finding:
        cameras = {view.camera_index for view in data.log.views if view.camera.exposure > 0}
        motions = exposure_motions(data.log.views)
        seen = [view for view in data.views if view.indices in motions]
        if not seen:
            what = "no camera of" if not cameras else "no clock and no readout tell how cameras move in"
            return Finding(
                called_for=False,
                reason=f"{what} {data.log.name}" + ("" if cameras else " declares how long it is exposed"),
                threshold=self.min_blur,
                unit="px",
                declared=True,
                missing="read the log with a reader that knows exposures and stamps of its images",
            )
        found = blur_length(seen, data.sweeps, motions)
        return Finding(
            called_for=found.pixels >= self.min_blur,
            reason=(
                f"{len(cameras)} of {data.log.num_cameras} cameras declare their exposure; a tenth of {found.points:,} "
                f"static points in {found.views} images move by {found.pixels:.2f} px or more during it"
            ),
            value=found.pixels,
            unit="px",
            threshold=self.min_blur,
            noise=found.error,
            declared=True,
        )

    def cost(self, data: TrainingData) -> Cost:
        """Each moment beside the first is a frame once more."""
        more = num_moments(self.detect(data).value or 0.0) - 1
        return Cost(ns_per_row=more * _BLUR_NS_PER_ROW, ns_per_pixel=more * _BLUR_NS_PER_PIXEL)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "MotionBlur":
        motions = exposure_motions(data.log.views)
        return MotionBlur(self, motions, num_moments(finding.value or 0.0))

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "MotionBlur":
        rows = [[tuple(map(float, part)) for part in row] for row in header["motions"]]
        motions = {
            (int(frame), int(camera)): Shutter(torch.tensor(moved), torch.tensor(turned), seconds=seconds, span=span)
            for (frame, camera), moved, turned, (seconds, span) in rows
        }
        if header["moments"] not in range(1, MAX_MOMENTS + 1):  # their weights take a matrix, each of them an image
            raise ValueError(
                f"an exposure has 1 to {MAX_MOMENTS} moments, got {header['moments']!r}: write the file again"
            )
        return MotionBlur(self, motions, header["moments"])


class MotionBlur(Effect):
    """Averages the light of a few moments of the exposure.

    A view that nobody recorded is sharp, and so is one whose camera says no exposure: videos are made of such.
    """

    settings: MotionBlurSettings

    def __init__(
        self, settings: MotionBlurSettings, motions: Mapping[tuple[int, int], Shutter], num_moments: int
    ) -> None:
        """``motions``: frame and camera of an image -> the motion of its camera during its exposure."""
        super().__init__(settings)
        self.motions, self.num_moments = dict(motions), num_moments

    def exposed(self, view: View) -> Exposed | None:
        if not view.camera.exposure > 0 or view.frame_index is None or view.camera_index is None:
            return None
        motion = self.motions.get(view.indices)
        if motion is None:
            return None
        instants = moments_of(self.num_moments)
        moments = [Moment(_moved(view.camera, motion, share), share, weight) for share, weight in instants]
        return Exposed(motion.span, tuple(moments))

    def header(self) -> dict[str, Any]:
        rows = [
            [list(indices), one.translation.tolist(), one.rotation.tolist(), [one.seconds, one.span]]
            for indices, one in self.motions.items()
        ]
        return {"motions": rows, "moments": self.num_moments}


def num_moments(pixels: float) -> int:
    """For a blur of so many pixels: two up to 3 pixels, and one more for each further 3.

    >>> [num_moments(pixels) for pixels in (0.5, 3.0, 3.1, 8.0, 50.0)]
    [2, 2, 3, 4, 5]
    """
    return min(max(1 + math.ceil(pixels / _PIXELS_A_MOMENT), 2), MAX_MOMENTS)


@cache
def moments_of(count: int) -> tuple[tuple[float, float], ...]:
    """Shares of an exposure, from its middle, and their weights: those of Gauss and Legendre.

    So two of them have the variance of all moments, 1/12 of the squared length, and three its fourth moment too.

    >>> [(round(share, 4), round(weight, 4)) for share, weight in moments_of(2)]
    [(-0.2887, 0.5), (0.2887, 0.5)]
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return tuple(zip((nodes / 2).tolist(), (weights / 2).tolist(), strict=True))


def _moved(camera: Camera, motion: Shutter, share: float) -> Camera:
    """The camera at a share of its motion, as the truth of a readout moves it: x_middle = R(share w) x + share t."""
    motion_of_share = torch.eye(4, dtype=torch.float64)
    turned = quat.from_rotation_vector(share * motion.rotation.double())
    motion_of_share[:3, :3] = quat.to_matrix(turned)
    motion_of_share[:3, 3] = share * motion.translation.double()
    moved: Float[Tensor, "4 4"] = inverse(motion_of_share) @ camera.camera_from_world.double()
    return replace(camera, camera_from_world=moved.to(camera.camera_from_world.dtype))
