"""The term of depths far ahead, which the images say and no lidar reaches."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.triangulation import SweepSettings, TriangulatedPoints
from sparsestreet.triangulation.sweep import swept_size
from sparsestreet.types import Frame, View

MIN_ALPHA = 0.5
"""What is drawn less is still more sky than surface, and its depth that of a fog."""


class FarDepthTerm:
    """Compares the depth that a swept view renders with that which the sweep found, at the pixels of its points.

    weight sum |log rendered - log swept| / (pixels that were swept): a mean over the image in which what is not known
    counts as right. A logarithm asks as much of a depth that is 10 % off at 20 m as of one at 100 m; an inverse depth
    asks a fifth.
    """

    def __init__(self, points: TriangulatedPoints, views: Sequence[View], settings: SweepSettings) -> None:
        """
        Args:
            points: far ahead, in the world, meters; each observed once.
            views: those that the points name, in their order.
            settings: of the sweep, with the weight.
        """
        self.weight = settings.depth_weight
        self._known: dict[tuple[int, int], tuple[Float[Tensor, "n 2"], Float[Tensor, " n"], int]] = {}
        places = torch.from_numpy(points.views)
        for place in places.unique().tolist():
            own, camera = places == place, views[place].camera
            axis = camera.camera_from_world[2]
            depths = torch.from_numpy(points.positions)[own].to(axis) @ axis[:3] + axis[3]
            shares = torch.from_numpy(points.pixels)[own] / torch.tensor([camera.width, camera.height])
            height, width = swept_size(camera, settings.width)
            self._known[views[place].indices] = shares, depths.float(), height * width

    def applies(self, frame: Frame) -> bool:
        """Whether the frame's view was swept."""
        return self.weight > 0 and frame.indices in self._known

    def __call__(self, rendering: SceneRendering, frame: Frame) -> Float[Tensor, ""]:
        """The weighted term of a frame to which it applies, of any size."""
        shares, depths, pixels = self._known[frame.indices]
        height, width = rendering.depth.shape
        column, row = (shares * torch.tensor([width, height])).long().unbind(1)
        at = row.clamp(max=height - 1) * width + column.clamp(max=width - 1)
        at, swept = (each.to(rendering.depth.device, non_blocking=True) for each in (at, depths))
        rendered, alpha = rendering.depth.flatten()[at], rendering.alpha.detach().flatten()[at]
        known = (alpha > MIN_ALPHA) & (rendered.detach() > 0)
        error = (torch.where(known, rendered, 1.0).log() - torch.where(known, swept, 1.0).log()).abs()
        return self.weight / pixels * error.sum()
