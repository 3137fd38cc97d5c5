"""KITTI's raw data as they are shipped."""

from sparsestreet.data.kitti.reader import KittiReader

__all__ = ["KittiReader"]
