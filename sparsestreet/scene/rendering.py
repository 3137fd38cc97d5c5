"""From a scene and a view to an image."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.cameras import project
from sparsestreet.ops import LeaveOneOutSums, splat
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.phases import phase
from sparsestreet.scene.effects.effect import Exposed, LinearizedEffects, linearized
from sparsestreet.scene.graph import SceneGaussians, SceneGraph
from sparsestreet.scene.state import DEFAULT_OPTIONS, FINISHED, RenderOptions, SceneState
from sparsestreet.types import Gaussians, Rendering, View


def light_of(stored: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Return the linear light of an sRGB image; 1 is white, and values outside of [0, 1] have a light and a gradient.

    >>> light_of(torch.tensor([[[0.0, 0.5, 1.0]]]))
    tensor([[[0.0000, 0.2140, 1.0000]]])
    """
    from kornia.color import rgb_to_linear_rgb  # a quarter of a second, for motion blur alone

    return rgb_to_linear_rgb(stored.movedim(2, 0)).movedim(0, 2)


def stored_of(light: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Return the sRGB image of linear light, the inverse of ``light_of``."""
    from kornia.color import linear_rgb_to_rgb

    return linear_rgb_to_rgb(light.movedim(2, 0)).movedim(0, 2)


NODE_COLORS = ((0.30, 0.60, 0.90), (0.98, 0.60, 0.15), (0.35, 0.80, 0.40), (0.90, 0.35, 0.60), (0.80, 0.75, 0.25))
"""RGB of the nodes in their order in the scene; the colors repeat if there are more nodes."""

BACKGROUND_COLOR = 0.05


def node_legend(nodes: Iterable[str]) -> dict[str, tuple[int, int, int]]:
    """Return name of a node, in the order of the scene -> 8-bit RGB of its dots.

    >>> node_legend(["background"])
    {'background': (76, 153, 230)}
    """
    return {name: _rgb8(*NODE_COLORS[position % len(NODE_COLORS)]) for position, name in enumerate(nodes)}


def _rgb8(red: float, green: float, blue: float) -> tuple[int, int, int]:
    return round(255 * red), round(255 * green), round(255 * blue)


@torch.no_grad()
def project_centers(scene: SceneGraph, view: View, *, min_opacity: float = 0.005) -> Float[Tensor, "h w 3"]:
    """Return an image in [0, 1] with one pixel per center in view, the nearest center on top.

    It omits rows below ``min_opacity``: those of absent instances, masked ones, and those about to be culled.
    """
    placed = scene.gaussians_at(view)
    camera = placed.view.camera
    colors = placed.gaussians.means.new_zeros(len(placed.gaussians), 3)
    for position, rows in enumerate(placed.spans.values()):
        colors[rows] = colors.new_tensor(NODE_COLORS[position % len(NODE_COLORS)])
    pixels, depth, inside = project(camera, placed.gaussians.means)
    drawn = inside & (placed.gaussians.opacities >= min_opacity)
    column, row = pixels[drawn].long().unbind(1)
    image = colors.new_full((camera.height * camera.width, 3), BACKGROUND_COLOR)
    target, nearest = _nearest_per_pixel(row * camera.width + column, depth[drawn], image.shape[0])
    image[target] = colors[drawn][nearest]
    return image.reshape(camera.height, camera.width, 3)


def _nearest_per_pixel(
    pixels: Int[Tensor, " n"], depth: Float[Tensor, " n"], num_pixels: int
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Return the pixels that are hit, and for each the point with the smallest depth."""
    order = depth.argsort(stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(order.shape[0], device=order.device)
    best = torch.full((num_pixels,), order.shape[0], device=order.device)
    best.scatter_reduce_(0, pixels, rank, "amin")
    hit = torch.nonzero(best < order.shape[0]).squeeze(1)
    return hit, order[best[hit]]


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
    changes: tuple[LeaveOneOutSums, LinearizedEffects] | None = None
    """What the backward pass finds out about leaving each row out, and how that shows in ``rgb``; None: nothing."""

    @property
    def drawn(self) -> dict[str, Bool[Tensor, " _"]]:
        """Name of a node -> which of its rows the view shows."""
        visible = self.splats.visible
        return {name: visible[rows] for name, rows in self.spans.items()}


def render(
    scene: SceneGraph,
    view: View,
    state: SceneState = FINISHED,
    options: RenderOptions = DEFAULT_OPTIONS,
    pixel_weights: Float[Tensor, "3 h w"] | None = None,
) -> SceneRendering:
    """Render the scene as a view sees it, in full precision also under autocast.

    ``pixel_weights``: how much a squared change of each pixel counts, in three ways; ``SceneRendering.changes`` then
    gathers how far the image changes without each row. None: it does not, as where masks hide rows of the step, or
    where light of several moments comes together.
    """
    with torch.autocast(scene.device.type, enabled=False):
        with phase("scene"):
            placed = scene.gaussians_at(view, state)
        exposed = scene.exposed(placed.view)
        if exposed is not None:
            return _gathered(scene, placed, exposed, state, options)
        return _drawn(scene, placed, state, options, pixel_weights)


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


def _drawn(
    scene: SceneGraph,
    placed: SceneGaussians,
    state: SceneState,
    options: RenderOptions,
    pixel_weights: Float[Tensor, "3 h w"] | None = None,
) -> SceneRendering:
    gaussians = placed.gaussians
    changes = None if pixel_weights is None or placed.gates is not None else _asked(scene, placed.view, pixel_weights)
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
            changes=None if changes is None else changes[0],
            replay=options.replay,
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
        changes,
    )


@torch.no_grad()
def _asked(
    scene: SceneGraph, view: View, pixel_weights: Float[Tensor, "3 h w"]
) -> tuple[LeaveOneOutSums, LinearizedEffects]:
    effects = linearized(scene.effects.values(), view)
    return LeaveOneOutSums(effects.weights(pixel_weights), effects.background), effects
