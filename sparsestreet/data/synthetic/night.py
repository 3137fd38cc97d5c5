"""Little light: images are dark, and what is left of the street lies in the noise of the sensor."""

from dataclasses import replace

import numpy as np

from sparsestreet.data.synthetic.instant import Sight
from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.settings import StreetSettings

_READ = 0.002
_SHOT = 0.01
"""Noise of the sensor in linear light: its square is _READ^2 + _SHOT^2 times the light."""


def at_night(settings: StreetSettings, sight: Sight, frame: int, camera: int) -> Sight:
    """Returns what the sensor records of 2^-night of the light; the noise of each image is its own."""
    if not settings.night:
        return sight
    dark = sight.linear * np.float32(2.0**-settings.night)
    drawn = stream(settings.seed, f"night {frame} {camera}").standard_normal(dark.shape, dtype=np.float32)
    return replace(sight, linear=dark + drawn * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(dark, 0)))
