"""Logs in DriveStudio's processed layout: read in the flavor of each of its data sets, written
in those of Waymo and nuScenes."""

from sparsestreet.data.drivestudio.reader import DriveStudioReader
from sparsestreet.data.drivestudio.writer import DriveStudioWriter

__all__ = ["DriveStudioReader", "DriveStudioWriter"]
