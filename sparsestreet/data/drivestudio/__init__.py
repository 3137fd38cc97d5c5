"""Logs in DriveStudio's processed layout: Waymo and nuScenes flavour."""

from sparsestreet.data.drivestudio.reader import DriveStudioReader

__all__ = ["DriveStudioReader"]
