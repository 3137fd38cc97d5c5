"""nuScenes as it is published: tables of JSON, and the files that they name, read and written."""

from sparsestreet.data.nuscenes.reader import NuScenesReader
from sparsestreet.data.nuscenes.writer import NuScenesWriter

__all__ = ["NuScenesReader", "NuScenesWriter"]
