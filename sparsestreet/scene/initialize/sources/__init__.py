"""Sources of a background's points, one a module: lidar, images, and guesses near and far.

A run's configuration lists its sources. Each claims a share of the node's points by what the images show
(``Coverage``), and draws them.
"""

from sparsestreet.scene.initialize.sources.far import FarPoints
from sparsestreet.scene.initialize.sources.images import ImagePoints
from sparsestreet.scene.initialize.sources.lidar import LidarPoints
from sparsestreet.scene.initialize.sources.near import NearPoints
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds

__all__ = ["FarPoints", "ImagePoints", "LidarPoints", "NearPoints", "PointSource", "Seeds"]
