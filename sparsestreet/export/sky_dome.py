"""The sky as a sphere of Gaussians far away, for viewers that know no sky."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from sparsestreet.export.recording import Cloud, Part
from sparsestreet.scene.effects import Sky
from sparsestreet.scene.graph import SceneGraph

_OVERLAP = 0.7
"""Standard deviation of a disc in distances to its neighbors: 3 % of what is behind comes through between three."""
_FLAT = 0.01
"""Thickness of a disc beside its width."""
_NEAREST, _FARTHEST = 500.0, 5000.0
"""Meters. Nearer, a drive would show that it is near; farther, variances no longer fit a viewer's half floats."""


def dome_around(scene: SceneGraph, parts: Sequence[Part]) -> Cloud | None:
    """Returns the sky of a scene around all its parts; None if it has none."""
    for effect in scene.effects.values():
        if isinstance(effect, Sky):
            reaches = [float(np.abs(shape.centers).max()) for part in parts for shape in part.shapes]
            return sky_dome(effect, min(max(2 * max(reaches, default=0.0), _NEAREST), _FARTHEST))
    return None


@torch.no_grad()
def sky_dome(sky: Sky, radius: float, count: int = 12_000) -> Cloud:
    """Returns discs on a sphere about the origin, meters, each of the color of the sky behind it.

    The discs are evenly spread along a spiral (Fibonacci lattice), sqrt(4 pi / count) radians apart: 1.9 degrees for
    12,000.
    """
    turns = np.arange(count) * math.pi * (3 - math.sqrt(5))
    heights = 1 - (2 * np.arange(count) + 1) / count
    flat = np.sqrt(1 - heights**2)
    directions = np.stack([flat * np.cos(turns), flat * np.sin(turns), heights], axis=1)
    width = _OVERLAP * radius * math.sqrt(4 * math.pi / count)
    outer = directions[:, :, None] * directions[:, None, :]
    covariances = width**2 * (np.eye(3) - (1 - _FLAT**2) * outer)
    colors = sky.colors(torch.from_numpy(directions).to(sky.texels)).clamp(0, 1).cpu().numpy()
    return Cloud(
        (radius * directions).astype(np.float32),
        covariances.astype(np.float32),
        colors.astype(np.float32),
        np.ones(count, np.float32),
    )
