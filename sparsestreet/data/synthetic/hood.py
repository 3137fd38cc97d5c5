"""The hood of the recording car, which covers the bottom of its cameras' images."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from sparsestreet.data.synthetic.cameras import StreetCamera
from sparsestreet.data.synthetic.instant import Sight
from sparsestreet.data.synthetic.parts import BACKGROUND
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.shading import mirrored
from sparsestreet.data.synthetic.sky import Weather
from sparsestreet.data.synthetic.textures.appearance import column

_PAINT = (0.03, 0.03, 0.035)
_GLOSS = 0.5
_BULGE = 0.25
"""Sideways slope of the hood at the image's borders; its middle is flat."""
_FALL = 0.05
"""Its slope towards the road ahead."""


def hood_coverage(settings: StreetSettings, camera: int) -> Float32[np.ndarray, "h w"] | None:
    """Returns the share of each pixel that the hood covers, ``settings.hood`` on average; None: the camera sees none.

    Its edge is a parabola, higher in the middle of the image than at the sides.
    """
    if not settings.hood or (camera > 0 and settings.hood_cameras == "front"):
        return None
    across = (np.arange(settings.width) + 0.5) / settings.width * 2 - 1
    # The mean of across^2 is 1/3.
    edge = settings.height * (1 - settings.hood * (1.1 - 0.3 * across**2))
    return np.clip(np.arange(1, settings.height + 1)[:, None] - edge, 0, 1).astype(np.float32)


def behind_hood(sight: Sight, coverage: Float32[np.ndarray, "h w"], camera: StreetCamera, weather: Weather) -> Sight:
    """Returns what a camera sees with the hood in front: neither street nor sky where half of a pixel is covered."""
    covered = coverage >= 0.5
    linear = sight.linear + coverage * (_hood(camera, weather) - sight.linear)
    objects = np.where(covered, np.int16(BACKGROUND), sight.object_indices)
    return replace(
        sight,
        linear=linear,
        depth=np.where(covered, np.float32(0), sight.depth),
        object_indices=objects,
        sky=sight.sky & ~covered,
    )


def _hood(camera: StreetCamera, weather: Weather) -> Float32[np.ndarray, "3 h w"]:
    """Returns the hood's light: dark paint in the shade, in which sky and street are mirrored."""
    towards = camera.rays(1).directions
    across = np.broadcast_to((np.arange(camera.width) + 0.5) / camera.width * 2 - 1, towards.shape[1:])
    local = np.stack((_BULGE * across, np.full_like(across, -1), np.full_like(across, _FALL)))
    normals = np.einsum("ij,jhw->ihw", camera.world_from_camera[:3, :3], local / np.linalg.norm(local, axis=0))
    directions, normals = (some.reshape(3, -1).astype(np.float32) for some in (towards, normals))
    shade, gloss = np.zeros(directions.shape[1], bool), np.full(directions.shape[1], _GLOSS, np.float32)
    light = column(_PAINT) * weather.ambient(normals) + mirrored(weather, directions, normals, gloss, shade)
    return light.reshape(towards.shape)
