"""The tile-vectorized torch blend against the reference: an oracle is worth as much as its own test."""

import pytest
import torch

from sparsestreet.bench import torch_tiles
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.reference import on_screen, visible_rows
from tests.ops.scenes import camera, cast, cotangents, random_gaussians, relative_error

pytestmark = pytest.mark.lengthy
SETTINGS = SplatSettings()


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        SplatSettings(stop="exclusive", transmittance_min=0.1),
        SplatSettings(max_sigma=1.5),
        SplatSettings(half_colors=True, depth_bits=12),
    ],
)
def test_image_and_gradients(settings):
    view = camera(37, 29)
    gaussians = random_gaussians(200, view)
    splats = on_screen(gaussians, visible_rows(gaussians, view, settings), view, settings)
    colors, transmittance = torch_tiles.blend(splats, 37, 29, settings)
    leaves = cast(gaussians, torch.float64, requires_grad=True)
    truth = splat(leaves, view, settings=settings, backend="reference")
    assert (colors - truth.rgb).abs().max() < 1e-12
    assert (1 - transmittance - truth.alpha).abs().max() < 1e-12
    # Through the projection of the reference, with the gradients of the tiles put in at the screen.
    cotangent = cotangents(view)[0]
    truth.rgb.backward(cotangent)
    other = cast(gaussians, torch.float64, requires_grad=True)
    graph = on_screen(other, visible_rows(other, view, settings), view, settings)
    gradients = torch_tiles.blend_gradients(splats, 37, 29, settings, cotangent)
    torch.autograd.backward([getattr(graph, name) for name in gradients], list(gradients.values()))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert relative_error(getattr(other, name).grad, getattr(leaves, name).grad) < 1e-10, name


def test_cpu_agrees_on_a_large_scene():
    view = frustum_camera(160, 96)
    gaussians = frustum_gaussians(6000, view, sigma_pixels=2.0, terms=1)
    splats = on_screen(gaussians, visible_rows(gaussians, view, SETTINGS), view, SETTINGS)
    image = splat(gaussians, view, backend="cpu").rgb
    difference = (image - torch_tiles.blend(splats, 160, 96, SETTINGS)[0]).abs().amax(-1)
    # A splat within rounding of the cut-off is blended by one and not by the other: at most one pixel in thousands.
    assert (difference > 1e-5).sum() <= 3
    assert difference.max() < 1 / 255
