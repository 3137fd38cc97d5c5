"""The motion blur of a camera: what moves while light falls on a pixel (``Camera.exposure``, docs/effects.md)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.evidence.motion import blur_length, exposure_motions
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Exposed, Finding, Moment
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.types import Camera, Shutter, View

MOST_MOMENTS = 5
_PIXELS_A_MOMENT = 3.0
"""A longer blur gets one moment more for each (docs/effects.md)."""
_NS_PER_ROW, _NS_PER_PIXEL = 84.0, 134.0
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
        return Cost(ns_per_row=more * _NS_PER_ROW, ns_per_pixel=more * _NS_PER_PIXEL)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "MotionBlur":
        motions = exposure_motions(data.log.views)
        return MotionBlur(self, motions, num_moments(finding.value or 0.0))

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "MotionBlur":
        rows = [[tuple(map(float, part)) for part in row] for row in header["motions"]]
        motions = {
            (int(frame), int(camera)): Shutter(torch.tensor(moved), torch.tensor(turned), seconds=seconds, span=span)
            for (frame, camera), moved, turned, (seconds, span) in rows
        }
        if header["moments"] not in range(1, MOST_MOMENTS + 1):  # their weights take a matrix, each of them an image
            raise ValueError(
                f"an exposure has 1 to {MOST_MOMENTS} moments, got {header['moments']!r}: write the file again"
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
    return min(max(1 + math.ceil(pixels / _PIXELS_A_MOMENT), 2), MOST_MOMENTS)


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
