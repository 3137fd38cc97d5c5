"""From a scene and a view to an image."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.geometry.cameras import ray_directions
from sparsestreet.ops import SplatSettings, over_sky, splat
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.phases import phase
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.sky import Sky
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Camera, Rendering, View


@dataclass(frozen=True)
class RenderOptions:
    """How a scene is rendered; training, pruning and evaluation take the same."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    backend: str = "auto"


DEFAULT_OPTIONS = RenderOptions()


@dataclass(frozen=True)
class SceneRendering:
    """An image of the scene and what losses, density control and pruning need to know about it."""

    rgb: Float[Tensor, "h w 3"]
    """Color over the sky (over black without one), not clamped."""
    alpha: Float[Tensor, "h w"]
    """Coverage by Gaussians; the sky does not count."""
    depth: Float[Tensor, "h w"]
    """Expected depth of the Gaussians along the optical axis, meters."""
    splats: Rendering
    """The op's answer, row-wise fields included."""
    spans: dict[str, slice]
    """Name of a node -> its rows in ``splats``."""
    parts: dict[str, RawGaussians]
    """Name of a node -> what it answered for the view, before activation."""

    @property
    def drawn(self) -> dict[str, Bool[Tensor, " _"]]:
        """Name of a node -> which of its rows the view shows."""
        visible = self.splats.visible
        return {name: visible[rows] for name, rows in self.spans.items()}

    state: SceneState = FINISHED
    options: RenderOptions = DEFAULT_OPTIONS
    """How it was rendered."""


def render(
    scene: SceneGraph, view: View, state: SceneState = FINISHED, options: RenderOptions = DEFAULT_OPTIONS
) -> SceneRendering:
    """Render the scene as a view sees it, in full precision also under autocast."""
    with torch.autocast(scene.device.type, enabled=False):
        with phase("scene"):
            placed = scene.gaussians_at(view, state)
        with phase("splat"):
            splats = splat(
                placed.gaussians,
                view.camera,
                settings=options.settings,
                backend=options.backend,
                screen_gradients=state.screen_gradients,
            )
        with phase("sky"):
            rgb = splats.rgb if scene.sky is None else _over_sky(splats, scene.sky, view.camera, options)
        return SceneRendering(rgb, splats.alpha, splats.depth, splats, placed.spans, placed.parts, state, options)


def sky_image(scene: SceneGraph, camera: Camera) -> Float[Tensor, "h w 3"] | None:
    """The sky in every pixel of a camera, as it is seen where nothing stands before it; None: black, no sky."""
    return None if scene.sky is None else scene.sky.colors(ray_directions(camera, scene.device))


def _over_sky(splats: Rendering, sky: Sky, camera: Camera, options: RenderOptions) -> Float[Tensor, "h w 3"]:
    """Sky behind the splats where more light gets through than at which the op stops a pixel, by the same backend."""
    backend = "torch" if options.backend == "reference" else options.backend
    limit = options.settings.transmittance_min
    return over_sky(splats.rgb, splats.alpha, sky.texels, camera, transmittance_min=limit, backend=backend)
