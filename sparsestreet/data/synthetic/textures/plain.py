"""One color, with or without grain."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.noise import smooth_noise
from sparsestreet.data.synthetic.textures.appearance import Appearance, Color, Vectors, column


@dataclass(frozen=True)
class Plain:
    """A single color, as of paint, metal, or cloth seen from far."""

    color: Color
    gloss: float = 0.0

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        albedo = np.repeat(column(self.color), points.shape[1], axis=1)
        return Appearance(albedo, np.full(points.shape[1], self.gloss, np.float32))


@dataclass(frozen=True)
class Grainy:
    """A color modulated by noise of two sizes: cloth, bark, foliage, rough walls."""

    color: Color
    coarse: float
    """Size of the large features, meters; the fine ones are a third of it."""
    contrast: float
    """Standard deviation of the relative brightness."""
    offset: float = 0.0
    """Meters by which the pattern is shifted, so that copies differ."""

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        # Each point uses the section of the noise that its surface faces most, so no section is seen edge-on.
        x, y, z = points + np.float32(self.offset)
        facing = np.abs(normals).argmax(0)
        u, v = np.where(facing == 0, y, x), np.where(facing == 2, y, z)
        width = footprints.max(0)
        grain = smooth_noise(u, v, self.coarse, width)
        grain += np.float32(0.6) * smooth_noise(u + v, u - v, self.coarse / 3, width)
        albedo = column(self.color) * np.maximum(1 + np.float32(self.contrast) * grain, np.float32(0.15))
        return Appearance(np.minimum(albedo, np.float32(0.95)), np.zeros(points.shape[1], np.float32))
