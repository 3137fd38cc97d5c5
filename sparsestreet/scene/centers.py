"""Draws the Gaussians as dots: one for every center, colored by node class."""

from collections.abc import Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry.cameras import project
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import View

NODE_COLORS = ((0.30, 0.60, 0.90), (0.98, 0.60, 0.15), (0.35, 0.80, 0.40), (0.90, 0.35, 0.60), (0.80, 0.75, 0.25))
"""RGB of the nodes in their order in the scene; the colors repeat if there are more nodes."""

BACKGROUND_COLOR = 0.05


def node_legend(nodes: Iterable[str]) -> dict[str, tuple[int, int, int]]:
    """Returns name of a node, in the order of the scene -> 8-bit RGB of its dots.

    >>> node_legend(["background"])
    {'background': (76, 153, 230)}
    """
    return {name: _rgb8(*NODE_COLORS[position % len(NODE_COLORS)]) for position, name in enumerate(nodes)}


def _rgb8(red: float, green: float, blue: float) -> tuple[int, int, int]:
    return round(255 * red), round(255 * green), round(255 * blue)


@torch.no_grad()
def project_centers(scene: SceneGraph, view: View, *, min_opacity: float = 0.005) -> Float[Tensor, "h w 3"]:
    """Returns an image in [0, 1] with one pixel per center in view, the nearest center on top.

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
    """Returns the pixels that are hit, and for each the point with the smallest depth."""
    order = depth.argsort(stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(order.shape[0], device=order.device)
    best = torch.full((num_pixels,), order.shape[0], device=order.device)
    best.scatter_reduce_(0, pixels, rank, "amin")
    hit = torch.nonzero(best < order.shape[0]).squeeze(1)
    return hit, order[best[hit]]
