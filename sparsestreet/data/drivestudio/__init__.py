"""Logs in DriveStudio's processed layout: Waymo and nuScenes flavour."""

from sparsestreet.data.drivestudio.check import check_drivestudio
from sparsestreet.data.drivestudio.reader import read_drivestudio
from sparsestreet.data.problems import LogError, Problem

__all__ = ["LogError", "Problem", "check_drivestudio", "read_drivestudio"]
