"""Learnable masks: which Gaussians a scene can do without."""

from sparsestreet.scene.masks.static import StaticMask
from sparsestreet.scene.masks.straight_through import straight_through

__all__ = ["StaticMask", "straight_through"]
