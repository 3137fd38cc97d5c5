"""The appearance of surface points, which the renderer asks of a surface."""

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
        """Returns the appearance at points of the part's frame; ``footprints`` are a pixel's extents in it, meters."""
        ...


def column(color: Color) -> Float32[np.ndarray, "3 1"]:
    return np.array(color, np.float32)[:, None]


def mix(below: Float32[np.ndarray, "3 _"], above: Float32[np.ndarray, "3 _"], share: Scalars) -> Vectors:
    """Returns ``below`` with ``above`` painted over it where ``share`` is 1.

    >>> mix(column((0.0, 0.0, 0.0)), column((1.0, 1.0, 1.0)), np.float32([0.25]))[0].tolist()
    [0.25]
    """
    return below + (above - below) * share
