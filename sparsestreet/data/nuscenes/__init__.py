"""nuScenes as it is published: tables of JSON, and the files that they name."""

from sparsestreet.data.nuscenes.reader import NuScenesReader

__all__ = ["NuScenesReader"]
