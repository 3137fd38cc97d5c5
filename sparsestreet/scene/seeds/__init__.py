"""Where the Gaussians of a node start: from lidar, from boxes, at random."""

from sparsestreet.scene.seeds.background import BackgroundSettings
from sparsestreet.scene.seeds.rigid import RigidSettings

__all__ = ["BackgroundSettings", "RigidSettings"]
