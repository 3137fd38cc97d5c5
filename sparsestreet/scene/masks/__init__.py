"""Learnable masks: which Gaussians a scene can do without.

``mask`` is what every mask answers; ``static`` one score per Gaussian, the same at all times; ``temporal`` one per
Gaussian and time, by a network; ``baked`` what it leaves behind: a bit per Gaussian and training frame.
"""

from sparsestreet.scene.masks.baked import BakedMask, BakedMaskSettings
from sparsestreet.scene.masks.mask import Mask, MaskScope, MaskSettings
from sparsestreet.scene.masks.static import StaticMask, StaticMaskSettings, straight_through
from sparsestreet.scene.masks.temporal import TemporalMask, TemporalMaskSettings

__all__ = [
    "BakedMask",
    "BakedMaskSettings",
    "Mask",
    "MaskScope",
    "MaskSettings",
    "StaticMask",
    "StaticMaskSettings",
    "TemporalMask",
    "TemporalMaskSettings",
    "straight_through",
]
