"""Gaussians of one moment as viewers of single objects want them: upright, with the sky as a dome, none unseen.

Files of 3DGS have x to the right, y down and z ahead, because the cameras that they were trained with do; viewers turn
them over. A street has x ahead, y to the left and z up.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.export.ply import scene_gaussians
from sparsestreet.export.recording import Cloud, Part
from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.spherical_harmonics import basis, of_colors
from sparsestreet.scene.effects import Sky
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Gaussians

_OVERLAP = 0.7
"""Standard deviation of a disc in distances to its neighbors: 3 % of what is behind comes through between three."""
_FLAT = 0.01
"""Thickness of a disc beside its width."""
_NEAREST_SKY_DOME, _FARTHEST_SKY_DOME = 500.0, 5000.0
"""Meters. Nearer, a drive would show that it is near; farther, variances no longer fit a viewer's half floats."""


def dome_around(scene: SceneGraph, parts: Sequence[Part]) -> Cloud | None:
    """Return the sky of a scene around all its parts; None if it has none."""
    for effect in scene.effects.values():
        if isinstance(effect, Sky):
            reaches = [float(np.abs(shape.centers).max()) for part in parts for shape in part.shapes]
            return sky_dome(effect, min(max(2 * max(reaches, default=0.0), _NEAREST_SKY_DOME), _FARTHEST_SKY_DOME))
    return None


@torch.no_grad()
def sky_dome(sky: Sky, radius: float, count: int = 12_000) -> Cloud:
    """Return discs on a sphere about the origin, meters, each of the color of the sky behind it.

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


VIEWER_FROM_WORLD = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""x ahead, y left, z up to x right, y down, z ahead."""

UNSEEN = 1 / 255
"""Opacity below which no viewer draws anything."""
_NEAREST, _FARTHEST = 500.0, 2000.0
"""Meters of the dome; within 2,048 a .spz keeps a fourth of a millimeter."""


@torch.no_grad()
def frame_gaussians(
    stored: StoredScene,
    time: float,
    *,
    nodes: Collection[str] | None = None,
    instances: Collection[str] | None = None,
    sky: bool = True,
) -> Gaussians:
    """Return the scene at a time in [0, 1] in the axes of viewers, those that are never seen left out.

    ``sky`` adds the dome where the whole scene is taken. Raises as ``scene_gaussians``, and ValueError where nothing is
    left.
    """
    found = scene_gaussians(stored, time, nodes=nodes, instances=instances)
    found = selected(found, found.opacities >= UNSEEN)
    if not len(found):
        raise ValueError("no Gaussian has an opacity of 1 / 255 or more: choose more, or another time")
    skies = [effect for effect in stored.scene.effects.values() if isinstance(effect, Sky)]
    if sky and skies and nodes is None and instances is None:
        reach = float(found.means.abs().max())
        dome = sky_dome(skies[0], min(max(2 * reach, _NEAREST), _FARTHEST))
        found = Gaussians.concatenate([found, _discs(dome, found.dense_sh().shape[1])])
    return turned(found, VIEWER_FROM_WORLD)


def selected(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    """Return some rows, on the host."""
    return Gaussians(**{name: column[rows].detach().cpu() for name, column in gaussians.columns().items()})


def turned(gaussians: Gaussians, rotation: Float[Tensor, "3 3"]) -> Gaussians:
    """Return the Gaussians as they are seen from axes that are turned: new = rotation @ old, harmonics as well."""
    turn = quat.from_matrix(rotation[None].double()).to(gaussians.quaternions)
    sh = gaussians.dense_sh()
    return replace(
        gaussians,
        means=gaussians.means @ rotation.T.to(gaussians.means),
        quaternions=quat.multiply(turn.expand(len(gaussians), 4), quat.normalized(gaussians.quaternions)),
        sh=torch.einsum("ij,njc->nic", turned_harmonics(rotation, sh.shape[1]).to(sh), sh),
    )


def turned_harmonics(rotation: Float[Tensor, "3 3"], terms: int) -> Float[Tensor, "k k"]:
    """Return the matrix that turns coefficients: colors along ``rotation @ d`` are those along d before.

    Solved from the basis at many directions, which no convention of signs can get wrong.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=1)
    before = basis(directions, terms)
    after = basis(directions @ rotation.T.double(), terms)
    return torch.linalg.lstsq(after, before).solution


def _discs(cloud: Cloud, terms: int) -> Gaussians:
    """Return the discs of a dome, whose thin axis is the last one."""
    variances, axes = torch.linalg.eigh(torch.from_numpy(cloud.covariances).double())
    axes = torch.where(torch.linalg.det(axes)[:, None, None] < 0, -axes, axes)
    colors = torch.zeros(len(cloud), terms, 3)
    colors[:, :1] = of_colors(torch.from_numpy(cloud.colors))
    return Gaussians(
        torch.from_numpy(cloud.centers),
        quat.from_matrix(axes).float(),
        variances.clamp(min=0).sqrt().float(),
        torch.from_numpy(cloud.opacities),
        colors,
    )
