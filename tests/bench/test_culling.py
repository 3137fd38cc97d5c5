"""Culling changes no bit of the C++ backend, and the test of that can fail."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.bench import culling
from sparsestreet.bench.effects import seen_through
from sparsestreet.bench.scenes import Size, bench_scenes
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.cpu.library import tile_size
from sparsestreet.ops.cpu.rasterizer import rasterize
from sparsestreet.types import Gaussians

pytestmark = pytest.mark.lengthy
SCENES = bench_scenes(Size(75, 53, 300))
DEFAULT = SplatSettings()
SETTINGS = {
    "default": DEFAULT,
    "exclusive": SplatSettings(stop="exclusive"),
    "max_sigma": SplatSettings(max_sigma=2.5, eps2d=0.1),
}


def tiles(scene) -> int:
    return -(-scene.camera.width // tile_size()) * -(-scene.camera.height // tile_size())


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("scene", SCENES, ids=[scene.name for scene in SCENES])
def test_image_and_gradients_are_identical(scene, settings):
    found = culling.compare_culling(scene.gaussians, scene.camera, settings)
    assert (found.pixels_changed, found.rows_changed) == (0, 0)
    assert 0 < found.pairs_listed < found.pairs
    assert found.rows_touching_other_pixels is None


@pytest.mark.parametrize("scene", SCENES[:3], ids=[scene.name for scene in SCENES[:3]])
def test_identical_through_lens_and_shutter(scene):
    seen = seen_through(scene, "lens and shutter")
    found = culling.compare_culling(seen.gaussians, seen.camera, DEFAULT)
    assert (found.pixels_changed, found.rows_changed) == (0, 0)
    assert 0 < found.pairs_listed < found.pairs


@pytest.mark.parametrize("scene", SCENES, ids=[scene.name for scene in SCENES])
def test_touched_pixels_are_those_of_the_dense_reference(scene):
    found = culling.compare_culling(scene.gaussians, scene.camera, DEFAULT)
    found = culling.compare_touched(found, scene.gaussians, scene.camera, DEFAULT)
    assert found.rows_touching_other_pixels == 0
    assert "0 pixels and 0 rows changed, 0 rows touch other pixels" in str(found)


def test_nothing_is_left_out_of_any_tile():
    """Rows in front of the camera are listed everywhere, also one beside the image, whose box would leave it out."""
    first = SCENES[0]
    fields = ("means", "quaternions", "scales", "opacities", "sh")
    three = Gaussians(*(getattr(first.gaussians, name)[:3].clone() for name in fields))
    three.means[1, 0] += 100.0
    three.means[2, 2] = -5.0
    found = culling.compare_culling(three, first.camera, DEFAULT)
    assert found.pairs == 2 * tiles(first)
    assert 0 < found.pairs_listed < tiles(first)
    assert (found.pixels_changed, found.rows_changed) == (0, 0)


@pytest.mark.parametrize("scene", SCENES[:2], ids=[scene.name for scene in SCENES[:2]])
def test_splats_that_end_too_early_are_found(scene, monkeypatch):
    """As if the lists ended at an alpha of 1/128 where the pixel loop ends at 1/255."""

    def tight(rows, offsets, camera, settings, every_tile):
        return rasterize(rows, offsets, camera, settings if every_tile else replace(settings, alpha_min=1 / 128))

    monkeypatch.setattr(culling, "rasterize", tight)
    found = culling.compare_culling(scene.gaussians, scene.camera, DEFAULT)
    assert found.pixels_changed > 0
    assert found.rows_changed > 0


def test_a_bit_of_one_pixel_counts():
    layers = torch.rand(6, 5)
    other = layers.clone()
    assert culling._different(layers, other) == 0
    other[4, 3] = torch.nextafter(other[4, 3], torch.tensor(2.0))
    other[1, 0] = float("nan")
    assert culling._different(layers, other) == 2
