"""Learnable masks: which Gaussians a scene can do without.

``mask`` is what every mask answers; ``static`` one score per Gaussian, the same at all times.
"""

from sparsestreet.scene.masks.mask import Mask, MaskSettings
from sparsestreet.scene.masks.static import StaticMask, StaticMaskSettings, straight_through

__all__ = ["Mask", "MaskSettings", "StaticMask", "StaticMaskSettings", "straight_through"]
