"""How far the image of what stands still moves while light falls on a pixel: the length of its blur."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import Sweeps
from sparsestreet.evidence.shear import ReadoutShear, readout_shear
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Shutter, View

QUANTILE = 0.9
"""Of the points of an image: a tenth of them is blurred by the measured length or more."""


def exposure_motions(views: Sequence[View]) -> dict[tuple[int, int], Shutter]:
    """Frame and camera -> how the camera moves while it is exposed, of images whose exposure is declared.

    From the motion during the readout, where that is declared with its seconds; else from the poses of the images
    before and behind, of the same camera. An image for which neither is there is left out, as is any without a clock.
    """
    by_camera: dict[int, list[View]] = defaultdict(list)
    for view in sorted(views, key=lambda view: view.time):
        by_camera[view.indices[1]].append(view)
    found = {}
    for own in by_camera.values():
        for place, view in enumerate(own):
            around = own[max(place - 1, 0)], own[min(place + 1, len(own) - 1)]
            motion = _exposed(view, *around) if view.camera.exposure > 0 else None
            if motion is not None:
                found[view.indices] = motion
    return found


def blur_length(views: Sequence[View], sweeps: Sweeps, motions: Mapping[tuple[int, int], Shutter]) -> ReadoutShear:
    """Pixels that a tenth of the lidar's points move during the exposure, or more: the mean over images.

    As a shear during the readout is measured. Points on moving objects count as if they stood still.
    """
    exposed = [view for view in views if view.indices in motions]
    moving = [replace(view, camera=replace(view.camera, shutter=motions[view.indices])) for view in exposed]
    return readout_shear(moving, sweeps, QUANTILE)


def _exposed(view: View, before: View, behind: View) -> Shutter | None:
    seconds, declared = view.camera.exposure, view.camera.shutter
    if declared is not None and declared.seconds > 0:
        share = seconds / declared.seconds
        parts = share * declared.translation, share * declared.rotation
        return Shutter(*parts, seconds=seconds, span=share * declared.span)
    if before.seconds is None or behind.seconds is None or not behind.seconds > before.seconds:
        return None
    share = seconds / (behind.seconds - before.seconds)
    first, pose, last = (_world_from(each.camera) for each in (before, view, behind))
    turn = quat.to_rotation_vector(quat.from_matrix(last[:3, :3] @ first[:3, :3].T))
    translation, rotation = (share * (pose[:3, :3].T @ each) for each in (last[:3, 3] - first[:3, 3], turn))
    return Shutter(translation.float(), rotation.float(), seconds=seconds, span=share * (behind.time - before.time))


def _world_from(camera: Camera) -> Float[Tensor, "4 4"]:
    return inverse(camera.camera_from_world.double())
