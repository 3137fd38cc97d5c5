"""Where the Gaussians of a node start: from lidar, from boxes, at random."""

from sparsestreet.scene.seeds.background import BackgroundSeeds
from sparsestreet.scene.seeds.rigid import RigidSeeds

__all__ = ["BackgroundSeeds", "RigidSeeds"]
