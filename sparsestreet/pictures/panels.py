"""What a picture of evidence is made of: small arrays with their words, drawn by ``pictures/evidence.py``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8


@dataclass(frozen=True)
class Dots:
    """Groups of points in a plane."""

    title: str
    x: str
    y: str
    groups: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    """Name -> both coordinates of its points."""
    joined: bool = False
    """Whether the points of a group are a curve."""
    diagonal: bool = False
    """Whether the line on which both coordinates are equal is drawn."""


@dataclass(frozen=True)
class Marked:
    """An image of the log, of which some pixels are marked."""

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Places:
    """Values at places of an image."""

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    pixels: Float[np.ndarray, "n 2"]
    values: Float[np.ndarray, " n"]
    unit: str


Panel = Dots | Marked | Places
