"""How a camera takes an image: its rows or columns one after the other, each exposed for a while."""

from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise

import numpy as np

from sparsestreet.data.synthetic.cameras import EVERYWHERE, StreetCamera, Window
from sparsestreet.data.synthetic.instant import Instant, Sight
from sparsestreet.data.synthetic.settings import StreetSettings

_STRIPS = 48
"""Rows of a strip share an instant, which is at most a 96th of the readout off: 0.3 of 30 ms, 0.1 pixels at 5 m."""
_NEAR = 5.0
"""Meters; what is passed this close moves about a pixel between two moments of an exposure."""


def captured(
    settings: StreetSettings,
    instant_at: Callable[[float], Instant],
    camera_at: Callable[[float], StreetCamera],
    exposure: float = 0.0,
) -> Sight:
    """Returns what a camera with the settings' readout sees, each strip of rows or columns at its own instant.

    Args:
        settings: ``readout`` and its direction, ``supersampling`` and, for the number of moments, ``ego_speed``.
        instant_at: the street, by seconds from the middle of the readout.
        camera_at: the camera where it is then.
        exposure: seconds over which light is averaged, as of a sensor: before it becomes stored values. Depth and
            objects are those of its middle.
    """
    camera = camera_at(0.0)
    reads_columns = settings.readout_direction in ("left", "right")
    sights = []
    for window, middle in _strips(settings, camera):
        sight = instant_at(middle).seen_by(camera_at(middle), settings.supersampling, window)
        if exposure:
            linear = np.zeros_like(sight.linear)
            moments = _moments(settings, camera, exposure)
            for moment in moments:
                time = middle + moment
                linear += instant_at(time).light(camera_at(time), settings.supersampling, window)
            sight = Sight(linear / np.float32(len(moments)), sight.depth, sight.object_indices, sight.sky)
        sights.append(sight)
    axis = -1 if reads_columns else -2
    return Sight(*(np.concatenate([getattr(sight, field.name) for sight in sights], axis) for field in fields(Sight)))


def _strips(settings: StreetSettings, camera: StreetCamera) -> list[tuple[Window, float]]:
    """Returns the image's strips from its top or left, and the middle of their exposure, seconds."""
    if not settings.readout:
        return [(EVERYWHERE, 0.0)]
    reads_columns = settings.readout_direction in ("left", "right")
    count = camera.width if reads_columns else camera.height
    sign = 1 if settings.readout_direction in ("top", "left") else -1
    strips = []
    for start, stop in pairwise(np.linspace(0, count, min(_STRIPS, count) + 1).round().astype(int).tolist()):
        part, everything = slice(start, stop), slice(None)
        window = (everything, part) if reads_columns else (part, everything)
        strips.append((window, sign * settings.readout * ((start + stop) / 2 / count - 0.5)))
    return strips


def _moments(settings: StreetSettings, camera: StreetCamera, exposure: float) -> list[float]:
    """Returns the middles of equal parts of an exposure, seconds from its own."""
    moved = float(camera.intrinsics[0, 0]) * settings.ego_speed * exposure / _NEAR
    count = int(np.clip(np.ceil(moved), 3, 9))
    return [exposure * ((place + 0.5) / count - 0.5) for place in range(count)]
