"""Logs in DriveStudio's processed layout: Waymo and nuScenes flavor."""

from sparsestreet.data.drivestudio.reader import DriveStudioReader

__all__ = ["DriveStudioReader"]
