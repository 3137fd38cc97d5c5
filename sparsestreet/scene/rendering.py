"""From a scene, a camera and a time to an image."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.cameras import ray_directions
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.node import MaskTerm
from sparsestreet.types import Camera, Rendering


@dataclass(frozen=True)
class SceneRendering:
    """An image of the scene and what losses, density control and pruning need to know about it."""

    rgb: Float[Tensor, "h w 3"]
    """Colour over the sky (over black without one), not clamped."""
    alpha: Float[Tensor, "h w"]
    """Coverage by Gaussians; the sky does not count."""
    depth: Float[Tensor, "h w"]
    """Expected depth of the Gaussians along the optical axis, metres."""
    splats: Rendering
    """The op's answer, row-wise fields included."""
    rows: dict[str, slice]
    """Name of a node -> its rows in ``splats``."""
    mask_terms: dict[str, MaskTerm]
    """Of the nodes that are being masked."""


def render(
    scene: SceneGraph,
    camera: Camera,
    time: float,
    *,
    settings: SplatSettings = SplatSettings(),  # noqa: B008 (frozen)
    backend: str = "auto",
) -> SceneRendering:
    """Render the scene at a normalised time in [0, 1], in full precision also under autocast."""
    with torch.autocast(camera.intrinsics.device.type, enabled=False):
        placed = scene.gaussians_at(time)
        background = None if scene.sky is None else scene.sky.colors(ray_directions(camera))
        splats = splat(placed.gaussians, camera, background=background, settings=settings, backend=backend)
        return SceneRendering(splats.rgb, splats.alpha, splats.depth, splats, placed.rows, scene.mask_terms())
