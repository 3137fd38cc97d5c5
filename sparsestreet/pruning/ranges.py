"""How far the depth of a view changes without each row, where a lidar says that the depth is right."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.lazy import as_frames
from sparsestreet.geometry.cameras import transform_points
from sparsestreet.ops import leave_one_out, splat
from sparsestreet.ops.spherical_harmonics import of_colors
from sparsestreet.pruning.select import RenderContext, on_device
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame, View

NEAREST, FARTHEST = 0.5, 80.0
"""Meters; returns outside are left out, as in the depth term of training."""
RIGHT = 0.1
"""Share of the recorded depth up to which a drawn one is right. What is wrong anyway has nothing to lose, and a few
returns that went through a window or past an edge would outweigh all others."""

MIN_ERROR = 1e-12
"""Squared error (images lie in [0, 1], depths are relative) that stands for no error; its inverse fits into float32."""


def depth_costs(scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Float64[Tensor, " _"]]:
    """Return name of a node -> the squared change of depth without each of its rows, relative to the present error.

    Of p passes each asks every p-th instant, in turn: neighbors show the same surfaces, and no training step has drawn
    what is asked here.
    """
    frames = as_frames(frames)
    turns = {
        instant: place % context.passes for place, instant in enumerate(sorted({v.indices[0] for v in frames.views}))
    }
    frames = frames.where(lambda view: turns[view.indices[0]] == context.passed % context.passes)
    error = torch.zeros((), dtype=torch.float64, device=scene.device)
    changes = error.new_zeros(sum(scene.counts().values()))
    for frame in on_device(scene, frames, context.ranks):
        if frame.depth is not None:
            # The lidar looks over the hood, which training does not show to the scene.
            depth = frame.depth if frame.ego is None else frame.depth.masked_fill(frame.ego, 0.0)
            of_view, change = depth_changes(scene, frame, depth, context)
            error, changes = error + of_view, changes + change
    costs = context.ranks.sum(changes) / context.ranks.sum(error).clamp(min=MIN_ERROR)
    return dict(zip(scene.nodes, costs.split(list(scene.counts().values())), strict=True))


def depth_changes(
    scene: SceneGraph, view: View, depth: Float[Tensor, "h w"], context: RenderContext
) -> tuple[Float64[Tensor, ""], Float64[Tensor, " n"]]:
    """Return the squared relative error of a view's depth, summed over right pixels, and its change without each row.

    A row's light is given the brightness 1 / z. The drawn image is then the inverse depth s of a pixel, with 0 for what
    lies at infinity, and linear in the alpha of each row as colors are. With the recorded depth d the relative error is
    s d - 1, and the change of row i is d (s - s without i).
    """
    placed = scene.gaussians_at(view, context.state)
    camera, settings, backend = placed.view.camera, context.options.settings, context.options.backend
    means = placed.gaussians.means
    z = transform_points(camera.camera_from_world.to(means), means)[:, 2].clamp(min=NEAREST)
    brightness = torch.stack((1 / z, torch.zeros_like(z), torch.zeros_like(z)), dim=1)
    inverse = replace(placed.gaussians, sh=of_colors(brightness))
    drawn = splat(inverse, camera, settings=settings, backend=backend, screen_gradients=False).rgb[..., 0]
    error = drawn * depth - 1
    right = (depth >= NEAREST) & (depth <= FARTHEST) & (error.abs() <= RIGHT)
    weights = torch.where(right, depth.square(), 0.0)
    change = leave_one_out(inverse, camera, pixel_weights=weights, settings=settings, backend=backend)
    return torch.where(right, error, 0.0).double().square().sum(), change.squared_change
