"""Culling changes no pixel, and the test of that can fail."""

from dataclasses import replace

import pytest

from sparsestreet.ops import SplatSettings
from sparsestreet.ops.bench import culling, torch_tiles
from sparsestreet.ops.bench.scenes import Size, bench_scenes
from sparsestreet.types import Gaussians

SCENES = bench_scenes(Size(53, 37, 150))


@pytest.mark.parametrize("scene", SCENES, ids=[scene.name for scene in SCENES])
def test_images_are_identical(scene):
    found = culling.compare_culling(scene.gaussians, scene.camera, SplatSettings())
    assert found.pixels_changed == 0
    assert found.rows_touching_other_pixels == 0
    assert 0 < found.pairs_listed < found.pairs


def test_tiles_without_a_splat_are_the_same():
    first = SCENES[0]
    one = Gaussians(
        *(getattr(first.gaussians, name)[:1] for name in ("means", "quaternions", "scales", "opacities", "sh"))
    )
    found = culling.compare_culling(one, first.camera, SplatSettings())
    assert 0 < found.pairs_listed < found.pairs == 12
    assert found.pixels_changed == 0


def test_boxes_that_are_too_small_are_found(monkeypatch):
    scene = SCENES[0]

    def tight(splats, tiles_x, tiles_y):
        return torch_tiles.tile_blocks(replace(splats, half_boxes=0.5 * splats.half_boxes), tiles_x, tiles_y)

    monkeypatch.setattr(culling, "tile_blocks", tight)
    assert culling.compare_culling(scene.gaussians, scene.camera, SplatSettings()).pixels_changed > 0
