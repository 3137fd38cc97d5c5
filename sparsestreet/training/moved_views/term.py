"""The terms of a step that renders its view once more from beside the path."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lidar import EdgeShift, edge_shift
from sparsestreet.geometry.boxes import displacement, without_frames
from sparsestreet.geometry.cameras import distance_to_view, moved, resized, transform_points
from sparsestreet.phases import stage
from sparsestreet.scene.build import assign_tracks
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import NodeSettings, RigidSettings
from sparsestreet.scene.rendering import SceneRendering, from_another_camera
from sparsestreet.training.moved_views.returns import NEAREST, MovedViews, StreetReturns, collect, kept_returns, target
from sparsestreet.types import Camera, Frame, View

_log = logging.getLogger(__name__)

CLEARANCE = 0.5
"""Meters that stay between a moved camera and what the lidar saw."""
_MARGIN = 0.1
"""Of the image on each side: what a lens shows beyond the pinhole's image."""


class MovedViewTerm:
    """Renders a step's Gaussians from a camera beside the recorded one, and compares them with the returns."""

    def __init__(self, settings: MovedViews, returns: StreetReturns, seed: int) -> None:
        self.settings = settings
        self.returns = returns
        self.seed = seed
        self._near: dict[tuple[int, int], tuple[Int[Tensor, " n"], tuple[float, float]]] = {}

    @property
    def frequency(self) -> float:
        """Moved views per step, over the whole run."""
        settings = self.settings
        return (settings.stop - settings.start) / settings.every if len(self.returns.street) else 0.0

    def applies(self, step: int, progress: float) -> bool:
        """Whether a step has a moved view."""
        settings = self.settings
        return (
            step % settings.every == 0 and settings.start <= progress < settings.stop and len(self.returns.street) > 0
        )

    def __call__(self, scene: SceneGraph, rendering: SceneRendering, frame: Frame) -> dict[str, Float[Tensor, ""]]:
        """The weighted terms. ``rendering`` is of the same instant: its Gaussians are drawn again.

        A draw depends on seed and step alone, so a resumed run draws the same as an uninterrupted one.
        """
        settings = self.settings
        generator = named_generator(self.seed, f"moved view {rendering.state.step}")
        rows, (left, right) = self._around(frame)
        distance = left + (right - left) * float(torch.rand((), generator=generator))
        camera = self._camera(frame.camera, distance)
        if len(rows) > settings.returns_per_view:
            rows = rows[torch.randint(len(rows), (settings.returns_per_view,), generator=generator)]
        index, _ = frame.indices
        found = target(
            camera,
            self.returns.street.at(rows),
            self.returns.objects_at(index, frame.time),
            self.returns.boxes(index, frame.time),
            0.5 / settings.divisor,
        )
        view = View(camera, frame.time, frame.frame_index, frame.camera_index, frame.seconds, frame.stamp)
        # The low-pass of the recorded image, in pixels of the smaller one: its pixels are samples of the recorded size.
        sampled = replace(rendering.options.settings, eps2d=rendering.options.settings.eps2d / settings.divisor**2)
        seen = from_another_camera(scene, rendering, view, replace(rendering.options, settings=sampled))
        device = seen.depth.device
        depth, weight = (each.to(device, non_blocking=True) for each in (found.depth, found.weight))
        known = (weight > 0) & (seen.depth.detach() > NEAREST)
        weight = torch.where(known, weight, 0.0) / weight.numel()
        inverse = 1 / torch.where(known, seen.depth, 1.0) - 1 / torch.where(known, depth, 1.0)
        # Returns have the exposures of many images: they are compared without any.
        missing = found.colors.to(device).missing(seen.rgb / scene.gain(view))
        return {
            "moved_depth": settings.depth_weight * (weight * inverse.abs()).sum(),
            "moved_color": settings.color_weight * (weight * missing.abs().mean(-1)).sum(),
        }

    def _camera(self, camera: Camera, distance: float) -> Camera:
        """The camera meters to its right, with a smaller image."""
        divisor = self.settings.divisor
        beside = moved(camera, distance * camera.camera_from_world[0, :3].double())
        return resized(beside, max(camera.height // divisor, 1), max(camera.width // divisor, 1))

    def _around(self, frame: Frame) -> tuple[Int[Tensor, " n"], tuple[float, float]]:
        """Rows of the street that cameras beside this one may see, and how far they may move: meters to the right."""
        if frame.indices not in self._near:
            rows = self.returns.around(frame.indices[0], self.settings.sweeps)
            points = self.returns.street.points[rows]
            inside = distance_to_view(frame.camera, points, _MARGIN) < self.settings.sideways
            limits = free_range(frame.camera, points, self.settings.sideways)
            self._near[frame.indices] = torch.nonzero(inside).squeeze(-1) + rows.start, limits
        return self._near[frame.indices]


def free_range(camera: Camera, points: Float[Tensor, "n 3"], sideways: float) -> tuple[float, float]:
    """How far a camera may move along its own x axis, from the leftmost to the rightmost place, meters.

    It keeps CLEARANCE to all points.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=4, height=4)
    >>> free_range(camera, torch.tensor([[1.5, 0.0, 0.1], [-9.0, 0.0, 0.0]]), sideways=3.0)
    (-3.0, 1.0)
    """
    x, y, z = transform_points(camera.camera_from_world.to(points), points).unbind(1)
    level = (y.abs() < CLEARANCE) & (z.abs() < CLEARANCE)
    right, left = x[level & (x > 0)], -x[level & (x <= 0)]
    free = [min(sideways, max(float(side.min()) - CLEARANCE, 0.0)) if len(side) else sideways for side in (left, right)]
    return -free[0], free[1]


MOVES = 0.5
"""Meters that an object which no node takes must get before it counts as moving."""
NOTICEABLE = 1.0, 2.0
"""Pixels between the edges of lidar and images, across and down, from which on a user is warned. Embedded streets that
fit have up to 0.4 and 1.0: lidars stand above cameras and look over edges."""


def moved_view_term(
    settings: MovedViews, data: StreetData, scene: SceneGraph, nodes: Mapping[str, NodeSettings], seed: int
) -> MovedViewTerm | None:
    """The terms of a run's moved views; None where no lidar says what these show. The program's log says which.

    The colors of returns lose the gains that the images have in the ``scene`` as it starts.

    Objects of rigid nodes are seen in moved views as the lidar saw them in the same instant. Of all other objects that
    move nothing is known there, nor of what lies behind them.
    """
    log, held_out = data.driving_log, data.split.held_out_indices
    sweeps = log.sweeps.where(lambda index: index not in held_out)
    if not len(sweeps):
        _log.info("no view beside the path is trained on: %s has no lidar", log.name)
        return None
    by_node = assign_tracks(log.tracks, nodes).by_node
    rigid = [track for name, tracks in by_node.items() if isinstance(nodes[name], RigidSettings) for track in tracks]
    taken = {track.name for tracks in by_node.values() for track in tracks}
    moving = [track for track in log.tracks if track.name in taken or displacement(track) > MOVES]
    moving, rigid = without_frames(moving, held_out), without_frames(rigid, held_out)
    with stage("points"), torch.no_grad():
        frames = data.split.train
        make = partial(collect, sweeps, frames, moving, rigid, settings, seed, scene.gain)
        gains = torch.stack([scene.gain(view) for view in frames.views])
        returns = kept_returns(log.kept, make, moving, rigid, settings, seed, gains)
    _log.info(
        "views beside the path: %s returns of the street, of mean weight %.2f (1: an image before or after shows the "
        "same color)",
        f"{len(returns.street):,}",
        returns.agreement(),
    )
    report_shift(log.kept.get("edges", (), lambda: edge_shift(data.split.train, sweeps), EdgeShift))
    return MovedViewTerm(settings, returns, seed)


def report_shift(shift: EdgeShift | None) -> None:
    """What lidar says of views beside the path is as right as it fits the recorded images."""
    if shift is None:
        _log.info("too few edges are seen by lidar and cameras to tell how well the two fit each other")
        return
    wrong = abs(shift.right) >= NOTICEABLE[0] or abs(shift.down) >= NOTICEABLE[1]
    level = logging.WARNING if wrong else logging.INFO
    advice = ": check calibration, poses and stamps, or train with moved_views=none" if wrong else ""
    _log.log(
        level,
        "edges of the images lie %.1f pixels to the right of those of the lidar and %.1f below%s",
        shift.right,
        shift.down,
        advice,
    )
