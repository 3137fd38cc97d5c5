"""Returns that belong together: neighbors in plan, within a reach that grows with the distance from the lidar."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse
from scipy.spatial import KDTree

from sparsestreet.tracking.ground import Ground
from sparsestreet.tracking.scans import Returns
from sparsestreet.tracking.settings import TrackingSettings

PLAN_CELL = 0.2
"""Meters: returns of one cell in plan are neighbors anyway, which leaves fewer to compare."""
MIN_RETURNS, MIN_HEIGHT = 3, 0.5
"""What has fewer returns, or none so high above the road, is noise; meters."""
MAX_RETURNS = 400
"""Returns of a cluster that are kept: more say no more about its outline."""
OUTLINE = (0.02, 0.98)
"""Quantiles of the coordinates that bound a cluster."""


@dataclass(frozen=True)
class Cluster:
    """Returns of one instant that may be one object."""

    returns: Returns
    middle: Float64[np.ndarray, "2"]
    """Of its outline in plan, meters, world."""
    extent: float
    """The longer side of its outline along the axes of the world, meters."""

    @staticmethod
    def of(returns: Returns) -> "Cluster":
        low, high = np.quantile(returns.points[:, :2], OUTLINE, axis=0)
        return Cluster(returns.thinned(MAX_RETURNS), (low + high) / 2, float((high - low).max()))


def find_clusters(returns: Returns, ground: Ground, settings: TrackingSettings) -> list[Cluster]:
    """Return the clusters of one instant's moving returns."""
    labels = cluster_labels(returns, settings)
    order = np.argsort(labels, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []
    heights = returns.points[:, 2] - ground.below(returns.points)
    large = [part for part in parts if len(part) >= MIN_RETURNS and heights[part].max() >= MIN_HEIGHT]
    return [Cluster.of(returns.where(part)) for part in large]


def cluster_labels(returns: Returns, settings: TrackingSettings) -> Int64[np.ndarray, " n"]:
    """Return the number of the connected component of each return.

    Two cells are neighbors if their first returns are nearer in plan than the smaller of their reaches.
    """
    if not len(returns):
        return np.zeros(0, np.int64)
    cells = np.floor(returns.points[:, :2] / PLAN_CELL).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    places = returns.points[first, :2]
    away = np.linalg.norm(places - returns.origins[first, :2], axis=1)
    reach = settings.cluster_gap + settings.cluster_gap_share * away
    rows, columns = KDTree(places).query_pairs(reach.max(), output_type="ndarray").T
    near = np.linalg.norm(places[rows] - places[columns], axis=1) < np.minimum(reach[rows], reach[columns])
    ones = np.ones(int(near.sum()))
    graph = sparse.coo_matrix((ones, (rows[near], columns[near])), shape=(len(places), len(places)))
    labels = sparse.csgraph.connected_components(graph, directed=False)[1]
    return labels.astype(np.int64)[cell.reshape(-1)]
