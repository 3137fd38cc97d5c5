"""From a scene and a view to an image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.ops import splat
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.phases import phase
from sparsestreet.scene.effects.effect import Exposed
from sparsestreet.scene.effects.light import light_of, stored_of
from sparsestreet.scene.graph import SceneGaussians, SceneGraph
from sparsestreet.scene.options import DEFAULT_OPTIONS, RenderOptions
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Gaussians, Rendering, View


@dataclass(frozen=True)
class SceneRendering:
    """An image of the scene and what losses, density control and pruning need to know about it."""

    rgb: Float[Tensor, "h w 3"]
    """Color behind all effects (over black without a sky), not clamped."""
    alpha: Float[Tensor, "h w"]
    """Coverage by Gaussians; effects do not count."""
    depth: Float[Tensor, "h w"]
    """Expected depth of the Gaussians along the optical axis, meters."""
    splats: Rendering
    """The op's answer, row-wise fields included."""
    spans: dict[str, slice]
    """Name of a node -> its rows in ``splats``."""
    parts: dict[str, RawGaussians]
    """Name of a node -> what it answered for the view, before activation."""
    gaussians: Gaussians
    """What was drawn, activated."""
    state: SceneState = FINISHED
    options: RenderOptions = DEFAULT_OPTIONS
    """How it was rendered."""
    gates: Float[Tensor, " n"] | None = None
    """Which of its Gaussians masks sampled for a training step; None: all."""

    @property
    def drawn(self) -> dict[str, Bool[Tensor, " _"]]:
        """Name of a node -> which of its rows the view shows."""
        visible = self.splats.visible
        return {name: visible[rows] for name, rows in self.spans.items()}


def render(
    scene: SceneGraph, view: View, state: SceneState = FINISHED, options: RenderOptions = DEFAULT_OPTIONS
) -> SceneRendering:
    """Render the scene as a view sees it, in full precision also under autocast."""
    with torch.autocast(scene.device.type, enabled=False):
        with phase("scene"):
            placed = scene.gaussians_at(view, state)
        exposed = scene.exposed(placed.view)
        if exposed is not None:
            return _gathered(scene, placed, exposed, state, options)
        return _drawn(scene, placed, state, options)


def from_another_camera(
    scene: SceneGraph, rendering: SceneRendering, view: View, options: RenderOptions
) -> SceneRendering:
    """Draw the Gaussians of a rendering once more, from another camera at the same instant.

    Nodes are not asked again, which saves their time, and gradients of both images reach them together. A field has
    deformed only what the first view could see. The image gathers no screen gradients.
    """
    state = replace(rendering.state, screen_gradients=False)
    with torch.autocast(scene.device.type, enabled=False):
        seen = scene.seen(view, state)
        placed = SceneGaussians(rendering.gaussians, rendering.spans, rendering.parts, seen, rendering.gates)
        return _drawn(scene, placed, state, options)


@dataclass(frozen=True)
class GatheredSplats(Rendering):
    """Splats of several moments of an exposure: means of what they show, the largest radius of each row."""

    moments: tuple[Rendering, ...] = ()

    @property
    def screen_gradients(self) -> Float[Tensor, "n 2"]:
        return torch.stack([one.screen_gradients for one in self.moments]).sum(0)


def _gathered(
    scene: SceneGraph, placed: SceneGaussians, exposed: Exposed, state: SceneState, options: RenderOptions
) -> SceneRendering:
    """The mean light of all moments. Rows move on lines; what a network changes in them meanwhile is left out."""
    with phase("scene"):
        moves = scene.displacements(placed.view, placed.parts, exposed.span)
    drawn, weights = [], [moment.weight for moment in exposed.moments]
    for moment in exposed.moments:
        gaussians = replace(placed.gaussians, means=placed.gaussians.means + moment.share * moves)
        then = replace(placed, gaussians=gaussians, view=replace(placed.view, camera=moment.camera))
        drawn.append(_drawn(scene, then, state, options))
    splats = [one.splats for one in drawn]
    gathered = GatheredSplats(
        rgb=_mean([one.rgb for one in splats], weights),
        alpha=_mean([one.alpha for one in splats], weights),
        depth=_mean([one.depth for one in splats], weights),
        radii=torch.stack([one.radii for one in splats]).amax(0),
        screen_offsets=splats[0].screen_offsets,
        moments=tuple(splats),
    )
    return replace(
        drawn[0],
        rgb=stored_of(_mean([light_of(one.rgb) for one in drawn], weights)),
        alpha=gathered.alpha,
        depth=gathered.depth,
        splats=gathered,
        gaussians=placed.gaussians,
    )


def _mean(images: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    return torch.stack([weight * image for weight, image in zip(weights, images, strict=True)]).sum(0)


def _drawn(scene: SceneGraph, placed: SceneGaussians, state: SceneState, options: RenderOptions) -> SceneRendering:
    gaussians = placed.gaussians
    for effect in scene.effects.values():
        gaussians = effect.gaussians(gaussians, placed.view)
    with phase("splat"):
        splats = splat(
            gaussians,
            placed.view.camera,
            settings=options.settings,
            backend=options.backend,
            screen_gradients=state.screen_gradients,
            gates=placed.gates,
        )
    rgb = splats.rgb
    for name, effect in scene.effects.items():
        if effect.has_image:
            with phase(name):
                rgb = effect.image(rgb, splats, placed.view, options)
    return SceneRendering(
        rgb,
        splats.alpha,
        splats.depth,
        splats,
        placed.spans,
        placed.parts,
        placed.gaussians,
        state,
        options,
        placed.gates,
    )
