"""How bright, and in which tint, a camera records its images."""

import numpy as np
from jaxtyping import Float32, Float64

from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.settings import StreetSettings

_SMOOTH = 0.5
"""Seconds over which the steps of a walk are averaged, as a camera's control reacts."""


def recorded_gains(settings: StreetSettings, frame: int, camera: int) -> Float32[np.ndarray, "3"] | None:
    """Returns factors of an image's stored red, green and blue; None if the settings have neither effect.

    They multiply sRGB values, not light: a learned gain of stored colors can undo them but for rounding and white.
    """
    if not settings.exposure_walk and not settings.white_balance:
        return None
    brightness = exposure_walk(settings, camera)[frame] * np.log(2)
    return np.exp(brightness + _tints(settings)[camera]).astype(np.float32)


def exposure_walk(settings: StreetSettings, camera: int) -> Float64[np.ndarray, " f"]:
    """Returns a camera's exposure in each frame, EV: mean 0 and the standard deviation of the settings.

    In a drive of one frame it is 0.
    """
    count = settings.num_frames
    window = np.hanning(2 + 2 * max(1, round(_SMOOTH * settings.frame_rate)))[1:-1]
    steps = stream(settings.seed, f"exposure {camera}").standard_normal(count + len(window))
    walk = np.cumsum(np.convolve(steps, window, "same"))[:count]
    walk -= walk.mean()
    return walk * (settings.exposure_walk / max(walk.std(), 1e-12))


def _tints(settings: StreetSettings) -> Float64[np.ndarray, "cameras 3"]:
    """Returns the logarithms of the constant gains: 0 on average over cameras, and over channels."""
    drawn = stream(settings.seed, "white balance").standard_normal((settings.num_cameras, 3))
    drawn -= drawn.mean(0)
    drawn -= drawn.mean(1, keepdims=True)
    return drawn * (settings.white_balance / max(drawn.std(), 1e-12))
