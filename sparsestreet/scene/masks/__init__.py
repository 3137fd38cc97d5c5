"""Learnable masks that find the Gaussians which a scene can do without.

``mask`` is the interface, and the result of a mask over time, a bit per Gaussian and training frame. ``static`` has one
score per Gaussian for all times. ``sampled`` has a probability per Gaussian and draws from it in every step.
``temporal`` has a network that gives one score per Gaussian and time.
"""

from sparsestreet.scene.masks.mask import BakedMask, BakedMaskSettings, Mask, MaskScope, MaskSettings
from sparsestreet.scene.masks.sampled import SampledMask, SampledMaskSettings
from sparsestreet.scene.masks.static import StaticMask, StaticMaskSettings, straight_through
from sparsestreet.scene.masks.temporal import TemporalMask, TemporalMaskSettings

__all__ = [
    "BakedMask",
    "BakedMaskSettings",
    "Mask",
    "MaskScope",
    "MaskSettings",
    "SampledMask",
    "SampledMaskSettings",
    "StaticMask",
    "StaticMaskSettings",
    "TemporalMask",
    "TemporalMaskSettings",
    "straight_through",
]
