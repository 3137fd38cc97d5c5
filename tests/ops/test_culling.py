"""Leaving out the tiles a splat does not reach changes no bit of the C++ backend, and the test of that can fail."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.bench.scenes import BenchScene, Size, bench_scenes, seen_through
from sparsestreet.bench.timing import GROUPS, Cotangent, last_workspace, leaves
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.cpu.rasterizer import rasterize
from tests.typed import there

SCENES = bench_scenes(Size(75, 53, 300))
SETTINGS = {
    "default": SplatSettings(),
    "exclusive": SplatSettings(stop="exclusive"),
    "max_sigma": SplatSettings(max_sigma=2.5, eps2d=0.1),
}


def drawn(scene: BenchScene, settings: SplatSettings, every_tile: bool) -> tuple[list[torch.Tensor], int]:
    """Layers and gradients, and the (splat, tile) pairs that were listed."""
    rows = leaves(scene.gaussians, torch.float32)
    offsets = torch.zeros(len(rows), 2, requires_grad=True)
    raster = rasterize(rows, offsets, scene.camera, settings, every_tile=every_tile)
    cotangent = Cotangent.of(scene.camera, rows.means)
    layers = [raster.rgb, raster.transmittance, raster.depth_sum]
    torch.autograd.backward(layers, [cotangent.rgb, cotangent.alpha, cotangent.alpha])
    values = [layer.detach() for layer in layers]
    del raster, layers  # without the graph, the workspace that counts pairs is free again
    gradients = [there(getattr(rows, name).grad) for name in GROUPS]
    return [*values, *gradients, there(offsets.grad)], last_workspace(torch.float32).pair_count()


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("place", range(len(SCENES)))
def test_image_and_gradients_are_identical(place, settings):
    """A term that is exactly zero changes no bit of a sum. One of the scenes is seen through a lens and a shutter."""
    scene = seen_through(SCENES[place], "lens and shutter" if place == 1 else None)
    (own, listed), (every, pairs) = (drawn(scene, settings, every_tile) for every_tile in (False, True))
    assert all(torch.equal(one, other) for one, other in zip(own, every, strict=True))
    assert 0 < listed < pairs


def test_splats_that_end_too_early_are_found():
    """As if the lists ended at an alpha of 1/128 where the pixel loop ends at 1/255."""
    tight = drawn(SCENES[0], replace(SplatSettings(), alpha_min=1 / 128), False)[0]
    assert not torch.equal(tight[0], drawn(SCENES[0], SplatSettings(), True)[0][0])
