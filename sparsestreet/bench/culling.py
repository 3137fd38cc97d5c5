"""Checks that leaving out the tiles a splat does not reach changes nothing: an identity, not a point on a curve.

The C++ backend can list every splat in front of the camera in every tile, and look at all lines of the tile. The
cut-off of a splat in a pixel stays. A term that is exactly zero changes no bit of a sum. So image and
gradients
must equal those over the tiles' own lists bit for bit.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sparsestreet.bench.timing import GROUPS, Cotangent, last_workspace, leaves
from sparsestreet.ops.cpu.rasterizer import rasterize
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import contribution
from sparsestreet.types import Camera, Gaussians


@dataclass(frozen=True)
class Culling:
    """What culling left out of one view, and whether that changed anything."""

    pairs: int
    """(splat, tile) pairs without culling: splats in front of the camera times tiles."""
    pairs_listed: int
    """Pairs in the tiles' own lists."""
    pixels_changed: int
    """Pixels whose color, transmittance or depth differs in any bit between the two (float32)."""
    rows_changed: int
    """Rows with a gradient that differs in any bit between the two."""
    rows_touching_other_pixels: int | None = None
    """Rows whose number of touched pixels differs between C++ and the dense reference (float64); None: not compared."""

    def __str__(self) -> str:
        touched = self.rows_touching_other_pixels
        return (
            f"{self.pairs_listed} of {self.pairs} pairs blended, {self.pixels_changed} pixels and {self.rows_changed} "
            f"rows changed" + ("" if touched is None else f", {touched} rows touch other pixels")
        )


def compare_culling(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Culling:
    """Draws and differentiates with the tiles' own lists, and with every splat in every tile.

    Raises PairLimitError if splats times tiles are more than the op holds.
    """
    own, every = (_draw(gaussians, camera, settings, every_tile) for every_tile in (False, True))
    return Culling(
        pairs=every.pairs,
        pairs_listed=own.pairs,
        pixels_changed=_different(own.layers, every.layers),
        rows_changed=_different(own.gradients, every.gradients),
    )


@torch.no_grad()
def compare_touched(culling: Culling, gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> Culling:
    """Adds which rows touch other pixels than in the dense reference; for small views."""
    doubled = leaves(gaussians, torch.float64)
    fast, dense = (contribution(doubled, camera, settings=settings, backend=name) for name in ("cpu", "reference"))
    return replace(culling, rows_touching_other_pixels=int((fast.pixels != dense.pixels).sum()))


@dataclass(frozen=True)
class _Drawn:
    layers: Tensor
    """[pixels, 5]"""
    gradients: Tensor
    """[rows, all parameters and the screen]"""
    pairs: int


def _draw(gaussians: Gaussians, camera: Camera, settings: SplatSettings, every_tile: bool) -> _Drawn:
    rows = leaves(gaussians, torch.float32)
    offsets = torch.zeros(len(rows), 2, requires_grad=True)
    raster = rasterize(rows, offsets, camera, settings, every_tile=every_tile)
    cotangent = Cotangent.of(camera, rows.means)
    layers = [raster.rgb, raster.transmittance, raster.depth_sum]
    torch.autograd.backward(layers, [cotangent.rgb, cotangent.alpha, cotangent.alpha])
    pixels = torch.cat([layer.detach().reshape(camera.height * camera.width, -1) for layer in layers], 1)
    del raster, layers  # without the graph, the workspace that counts pairs is free again
    gradients = [*(getattr(rows, name).grad for name in GROUPS), offsets.grad]
    flat = torch.cat([gradient.flatten(1) if gradient.dim() > 1 else gradient[:, None] for gradient in gradients], 1)
    return _Drawn(pixels, flat, last_workspace(torch.float32).pair_count())


def _different(own: Tensor, every: Tensor) -> int:
    """Rows that differ in a bit; 0 and -0 are equal, NaN differs from everything."""
    return int((own != every).any(-1).sum())
