"""Intensities of lidar returns: one number a Gaussian, the mean of the recorded returns whose rays end at it.

A Gaussian that no return met takes that of the nearest one of its node and object that a return did. What a return's
intensity owes to range and angle of incidence is in its mean, as it was where the log saw it.
"""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.scene.gaussians import INTENSITIES, Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.lidar import rays_to, render_ranges
from sparsestreet.scene.state import RenderOptions
from sparsestreet.types import Sweep

MAX_ERROR = 0.05, 0.2
"""Share of a recorded range, and meters, by which the drawn one may differ: else another thing was hit."""
_APART = 1e4
"""Meters between two objects of a node, whose rows are all near zero: none is the nearest to a row of another."""


@torch.no_grad()
def learn_intensities(
    scene: SceneGraph, returns: Iterable[tuple[Sweep, Float[Tensor, " _"]]], options: RenderOptions
) -> int:
    """Write the column ``intensities`` of every node, and return how many rows some return met.

    Args:
        scene: a trained scene; nodes that no return met get no column.
        returns: sweeps with a known origin, and the intensities of their points, in [0, 1].
        options: how the scene is rendered.

    Raises ValueError as ``render_ranges``.
    """
    count = sum(scene.counts().values())
    sums, hits = torch.zeros(2, count, dtype=torch.float64, device=scene.device)
    for sweep, values in returns:
        places, ranges, rays = rays_to(sweep)
        met = render_ranges(scene, rays, sweep.time, options)
        share, meters = MAX_ERROR
        right = (met.ranges.double() - ranges).abs() <= share * ranges + meters
        rows, own = met.rows[right].to(sums.device), values[places][right].to(sums)
        sums.index_add_(0, rows, own)
        hits.index_add_(0, rows, torch.ones_like(own))
    start = 0
    for node in scene.nodes.values():
        own_rows = slice(start, start + len(node.rows))
        if hits[own_rows].any():
            levels = _filled(node.rows, sums[own_rows].cpu().numpy(), hits[own_rows].cpu().numpy())
            node.rows.register_buffer(INTENSITIES, torch.from_numpy(levels).to(scene.device))
        start = own_rows.stop
    return int((hits > 0).sum())


def _filled(rows: Rows, sums: Float64[np.ndarray, " n"], hits: Float64[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """Means in 255 steps, of rows without a hit those of the nearest row with one."""
    columns, met = rows.columns(), hits > 0
    places = columns["means"].detach().double().cpu().numpy()
    if "instances" in columns:
        places = np.column_stack((places, _APART * columns["instances"].cpu().numpy()))
    levels = np.rint(255 * sums[met] / hits[met]).astype(np.uint8)
    _, nearest = KDTree(places[met]).query(places)
    return levels[nearest]


def intensities_of(scene: SceneGraph) -> Float[Tensor, " n"] | None:
    """Return those of all rows in the order of the nodes, in [0, 1]: 0 in nodes without; None if no node has any."""
    columns = [node.rows.columns() for node in scene.nodes.values()]
    if not any(INTENSITIES in one for one in columns):
        return None
    return torch.cat([one.get(INTENSITIES, torch.zeros_like(one["means"][:, 0])).float() for one in columns]) / 255
