"""Entries of COLMAP's tables, however they are written."""

from dataclasses import dataclass

from sparsestreet.data.colmap.lenses import CameraModel


@dataclass(frozen=True)
class CameraRow:
    """An entry of ``cameras``."""

    number: int
    model: CameraModel
    size: tuple[int, int]
    """(width, height), pixels."""
    numbers: tuple[float, ...]
    """As many as the model has."""


@dataclass(frozen=True)
class ImageRow:
    """An entry of ``images``."""

    number: int
    name: str
    camera: int
    pose: tuple[float, ...]
    """camera_from_world: a quaternion wxyz and a translation."""
