"""What a surface tells the renderer about its points."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

Vectors = Float32[np.ndarray, "3 n"]
Scalars = Float32[np.ndarray, " n"]
Color = tuple[float, float, float]
"""Linear RGB reflectance in [0, 1]."""


@dataclass(frozen=True)
class Appearance:
    """Appearance of surface points."""

    albedo: Vectors
    """Linear RGB reflectance."""
    gloss: Scalars
    """Weight of the mirrored sky in [0, 1]; 0 is matt."""


@runtime_checkable
class Surface(Protocol):
    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        """Appearance at points of the part's own frame; ``footprints`` are a pixel's extents along its axes, meters."""
        ...


def column(color: Color) -> Float32[np.ndarray, "3 1"]:
    return np.array(color, np.float32)[:, None]


def mix(below: Float32[np.ndarray, "3 _"], above: Float32[np.ndarray, "3 _"], share: Scalars) -> Vectors:
    """``above`` painted over ``below`` where ``share`` is 1."""
    return below + (above - below) * share
