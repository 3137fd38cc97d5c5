"""The scenes are what their names say, and the same every time."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.bench.scenes import STACK, Size, bench_scenes, deep_stack, needles_and_giants
from sparsestreet.bench.street import proxy_street
from sparsestreet.ops import SplatSettings, contribution
from sparsestreet.ops.reference import visible_rows

SIZE = Size(96, 64, 1500)
FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


def test_five_scenes_the_same_for_the_same_seed():
    first, again, other = bench_scenes(SIZE), bench_scenes(SIZE), bench_scenes(SIZE, seed=1)
    assert len(first) == 5
    for a, b in zip(first, again, strict=True):
        assert all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in FIELDS)
        assert len(a.gaussians) == SIZE.rows
        assert a.gaussians.sh.shape == (SIZE.rows, 16, 3)
    assert not torch.equal(first[0].gaussians.means, other[0].gaussians.means)


def test_deep_stack_is_as_deep_as_it_says():
    scene = deep_stack(SIZE)
    never_stop = SplatSettings(transmittance_min=0.0)
    touched = contribution(scene.gaussians, scene.camera, settings=never_stop, backend="cpu").pixels.sum()
    depth = float(touched) / (SIZE.width * SIZE.height)
    # Centers lie inside the image only, so that of the stack at an edge half is missing.
    assert 0.75 * STACK < depth < STACK


def test_needles_are_thin_and_giants_large():
    scene = needles_and_giants(SIZE)
    pixels = scene.gaussians.scales / scene.gaussians.means[:, 2:] * SIZE.width
    ratio = pixels.amax(1) / pixels.amin(1)
    assert 0.45 < float((ratio > 20).float().mean()) < 0.55
    assert 0.03 < float((pixels.amin(1) > 0.09 * SIZE.width).float().mean()) < 0.07


def test_half_of_the_street_is_masked_and_nothing_else_changes():
    *_, street, masked = bench_scenes(SIZE)
    gone = masked.gaussians.opacities == 0
    assert 0.45 < float(gone.float().mean()) < 0.55
    assert torch.equal(masked.gaussians.opacities[~gone], street.gaussians.opacities[~gone])
    assert torch.equal(masked.gaussians.means, street.gaussians.means)
    assert "half masked" in masked.name
    assert "not trained" in street.source


def test_a_given_street_takes_the_place_of_the_proxy():
    street = replace(bench_scenes(SIZE)[3], name="trained street", source="trained: a run")
    *_, kept, masked = bench_scenes(SIZE, street)
    assert kept is street
    assert masked.name == "trained street, half masked"


@pytest.mark.parametrize("rows", [0, 1, 7, 500])
def test_proxy_has_as_many_rows_as_asked_for(rows):
    assert len(proxy_street(rows, terms=4)) == rows


def test_most_of_the_proxy_is_seen():
    street = bench_scenes(SIZE)[3]
    visible = visible_rows(street.gaussians, street.camera, SplatSettings())
    assert len(visible) > 0.6 * SIZE.rows
    assert bool(torch.isfinite(street.gaussians.sh).all())
