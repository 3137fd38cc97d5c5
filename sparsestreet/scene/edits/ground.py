"""The ground of a scene: what covers most of a place seen from above, near the feet of objects that were recorded."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.scene.edits.nodes import AddedObject, EditedNode
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.tracked import Tracked

_LAYER = 0.3
"""Meters of height that hold the ground; trees spread over more, and so do guesses below it."""
MIN_GAUSSIANS = 5
"""Around a place, to tell the ground's height by."""
_RADII = (1.0, 2.0, 4.0, 8.0)
"""Meters around a place: the first that has enough Gaussians."""
MAX_AWAY = 20.0
"""Meters within which the feet of objects tell about the ground."""
_PLAY, _RISE = 0.5, 0.1
"""Meters that curbs and boxes are off, and what a street rises a meter at most."""


class Ground:
    """Heights of the ground, of nodes without tracks and of the boxes that stand on it."""

    def __init__(self, scene: SceneGraph) -> None:
        """Read a scene; objects that edits moved or added say nothing of it."""
        still = [node.rows for node in scene.nodes.values() if not isinstance(node, Tracked | EditedNode | AddedObject)]
        tracked = [node for node in scene.nodes.values() if isinstance(node, Tracked)]
        self._feet = np.concatenate([np.zeros((0, 3)), *map(_feet, tracked)])
        layers = [(torch.zeros(0, 3), torch.zeros(0)), *map(_flat, still)]
        self._means, self._cover = (torch.cat(columns) for columns in zip(*layers, strict=True))

    def below(self, x: float, y: float) -> float | None:
        """Return the height of the ground at a place of the world, meters; None where nothing tells.

        It is that of the layer that covers most, seen from above, in the smallest circle that has enough Gaussians.
        Where an object stood within 20 m, the layer is about as high as its feet; without any Gaussians it is that.
        """
        away = torch.linalg.vector_norm(self._means[:, :2] - torch.tensor([x, y]), dim=1)
        stood = np.linalg.norm(self._feet[:, :2] - [x, y], axis=1)
        feet = None
        if len(stood) and stood.min() < MAX_AWAY:
            feet = float(self._feet[stood.argmin(), 2])
            play = _PLAY + _RISE * float(stood.min())
            away = torch.where((self._means[:, 2] - feet).abs() < play, away, torch.inf)
        for radius in _RADII:
            near = away < radius
            if int(near.sum()) >= MIN_GAUSSIANS:
                return _fullest(self._means[near, 2], self._cover[near])
        return feet

    def off(self, x: float, y: float, z: float) -> float | None:
        """Return how far a place is above the ground (below: negative), meters; None where nothing tells."""
        below = self.below(x, y)
        return None if below is None else z - below


@torch.no_grad()
def _flat(rows: Rows) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return the places of Gaussians that fit into a layer, and how much each covers: its area, by its opacity."""
    axes = quat.to_matrix(torch.nn.functional.normalize(rows.quaternions, dim=1)) * rows.log_scales.exp()[:, None]
    (xx, yy, zz), xy = (axes**2).sum(2).T, (axes[:, 0] * axes[:, 1]).sum(1)
    cover = rows.opacity_logits.flatten().sigmoid() * (xx * yy - xy**2).clamp_min(0).sqrt()
    flat = zz.sqrt() < _LAYER
    return rows.means.detach()[flat].cpu(), cover[flat].cpu()


@torch.no_grad()
def _feet(node: Tracked) -> Float64[np.ndarray, "k 3"]:
    """Return where the objects of a node stood at the times of their boxes."""
    heights = np.array([node.frame_height(number) for number in range(len(node.names))])
    found = []
    for time in node.keyframe_times[node.keyframe_valid].unique().tolist():
        poses = node.pose_at(time)
        frames = node.object_frames(poses)[poses.present.cpu().numpy()]
        found.append(frames[:, :3, 3] - heights[poses.present.cpu().numpy(), None] * frames[:, :3, 2])
    return np.concatenate([np.zeros((0, 3)), *found])


def _fullest(heights: Float[Tensor, " n"], cover: Float[Tensor, " n"]) -> float:
    """Return the median height of the layer that covers most."""
    heights, order = heights.sort()
    below = torch.nn.functional.pad(cover[order].cumsum(0), (1, 0))
    held = below[torch.searchsorted(heights, heights + _LAYER, right=True)] - below[:-1]
    start = float(heights[held.argmax()])
    return float(heights[(heights >= start) & (heights <= start + _LAYER)].median())
