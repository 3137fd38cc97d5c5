"""Dirt on the lens of the front camera: dark, soft spots that stay while the street passes."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from sparsestreet.data.synthetic.instant import Sight
from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.settings import StreetSettings

_SPOTS = 3
_OPACITY = 0.95
_LIGHT = 0.04
"""What reaches the sensor through a spot, linear."""
_SOFT = 0.25
"""Of the radius, on both sides of it: over this much a spot fades."""


def dirt_opacity(settings: StreetSettings, camera: int) -> Float32[np.ndarray, "h w"] | None:
    """Returns the share of each pixel's light that dirt takes; None: the camera is clean.

    Three spots of one size, away from each other and from the border. Where they take half of the light they cover
    ``settings.dirt`` of the image.
    """
    if not settings.dirt or camera > 0:
        return None
    width, height = settings.width, settings.height
    radius = np.sqrt(settings.dirt * width * height / (np.pi * _SPOTS))
    draw, centers = stream(settings.seed, "dirt"), np.empty((0, 2))
    reach = np.minimum(1.3 * radius, (0.45 * width, 0.45 * height))
    while len(centers) < _SPOTS:
        center = draw.uniform(reach, (width - reach[0], height - reach[1]))
        if len(centers) == 0 or np.linalg.norm(centers - center, axis=1).min() > 2.6 * radius:
            centers = np.vstack((centers, center))
    y, x = np.mgrid[:height, :width] + 0.5
    distances = np.hypot(x - centers[:, 0, None, None], y - centers[:, 1, None, None]).min(0) / radius
    return (_OPACITY * np.clip((1 + _SOFT - distances) / (2 * _SOFT), 0, 1)).astype(np.float32)


def behind_dirt(sight: Sight, opacity: Float32[np.ndarray, "h w"]) -> Sight:
    """Returns what a camera sees through the dirt; depth and objects are those of the street."""
    return replace(sight, linear=sight.linear * (1 - opacity) + np.float32(_LIGHT) * opacity)
