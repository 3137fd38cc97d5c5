"""KITTI-360 as it is shipped."""

from sparsestreet.data.kitti360.reader import Kitti360Reader

__all__ = ["Kitti360Reader"]
