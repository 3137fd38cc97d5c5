"""KITTI's raw data as they are shipped: read and written."""

from sparsestreet.data.kitti.reader import KittiReader
from sparsestreet.data.kitti.writer import KittiWriter

__all__ = ["KittiReader", "KittiWriter"]
