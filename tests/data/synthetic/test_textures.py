"""Filtered stripes against numerical averages; noise and looks of every surface at all distances."""

import numpy as np
import pytest

from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.textures import Grainy, beyond, cell_random, smooth_noise, stream, strip, stripes
from sparsestreet.data.synthetic.tracer import Part
from sparsestreet.data.synthetic.world import build_world


def average(indicator, x, footprint):
    """Mean of a 0/1 function over [x - footprint/2, x + footprint/2], float64."""
    offsets = (np.arange(4000) + 0.5) / 4000 - 0.5
    return indicator(x[:, None].astype(np.float64) + footprint[:, None] * offsets).mean(1)


@pytest.mark.parametrize("width", [0.01, 0.3, 2.7])
def test_coverage_is_the_average_over_the_footprint(width):
    rng = np.random.default_rng(0)
    x = rng.uniform(-4, 4, 57).astype(np.float32)
    footprint = np.full(57, width, np.float32)
    cases = [
        (strip(x, -0.5, 0.8, footprint), lambda p: (p > -0.5) & (p < 0.8)),
        (beyond(x, 0.3, footprint), lambda p: p > 0.3),
        (stripes(x, 1.1, 0.2, 0.5, footprint), lambda p: (p % 1.1 > 0.2) & (p % 1.1 < 0.5)),
    ]
    for covered, indicator in cases:
        # 4000 samples resolve 1/4000 per edge; float32 differences of sums add 1e-6 / 0.01.
        np.testing.assert_allclose(covered, average(indicator, x, footprint), atol=1.5e-3)


def test_noise_has_unit_variance_near_and_vanishes_far():
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-80, 80, (2, 20000)).astype(np.float32)
    near, far = np.zeros(20000, np.float32), np.full(20000, 1.0, np.float32)
    values = smooth_noise(u, v, 0.5, near)
    assert abs(values.mean()) < 0.1
    assert 0.8 < values.std() < 1.2
    assert (smooth_noise(u, v, 0.5, far) == 0).all()
    # One texel is 1/32 of a cell; the fade's slope is at most 1.875 and values span about 6: steps up to 0.35.
    assert np.abs(smooth_noise(u + 0.005, v, 0.5, near) - values).max() < 0.4


def test_cell_random_is_uniform_and_depends_on_all_inputs():
    i, j = np.meshgrid(np.arange(-50, 50), np.arange(-50, 50))
    i, j = i.ravel().astype(np.float32), j.ravel().astype(np.float32)
    values = cell_random(i, j, 5)
    assert values.min() >= 0
    assert values.max() < 1
    counts, _ = np.histogram(values, bins=10, range=(0, 1))
    # 10000 draws, 1000 expected per bin with standard deviation 30: five of them.
    assert np.abs(counts - 1000).max() < 150
    for other in (cell_random(i + 1, j, 5), cell_random(i, j + 1, 5), cell_random(i, j, 6)):
        assert abs(np.corrcoef(values, other)[0, 1]) < 0.05


def test_streams_differ_by_seed_and_name():
    draws = [stream(seed, name).random() for seed in (0, 1) for name in ("a", "b")]
    assert len(set(draws)) == 4
    assert stream(0, "a").random() == draws[0]


def test_grain_neither_blackens_nor_glows():
    """A standard deviation of twice the color is cut off at 0.15 of it and at a reflectance of 0.95."""
    points = np.random.default_rng(3).uniform(-20, 20, (3, 500)).astype(np.float32)
    up = np.zeros_like(points)
    up[2] = 1
    albedo = Grainy((0.4, 0.5, 0.6), 0.5, 2.0).appearance(points, up, np.zeros_like(points)).albedo
    np.testing.assert_allclose(albedo.min(1), [0.06, 0.075, 0.09], rtol=1e-6)
    np.testing.assert_allclose(albedo.max(1), 0.95, rtol=1e-6)


def surfaces() -> dict[str, Part]:
    """One part of every kind of surface in a street."""
    world = build_world(StreetSettings(num_frames=2))
    return {type(part.surface).__name__: part for part in world.parts_at(0.0)}


@pytest.mark.lengthy
@pytest.mark.parametrize("name", sorted(surfaces()))
def test_looks_are_colors_and_flatten_with_distance(name):
    part = surfaces()[name]
    rng = np.random.default_rng(2)
    # Rays from all around, onto the part's surface.
    half = part.shape.half_extent.astype(np.float64)
    around = rng.standard_normal((3, 400))
    origins = around / np.linalg.norm(around, axis=0) * half.max() * 3
    towards = rng.uniform(-0.8, 0.8, (3, 400)) * half[:, None] - origins
    directions = (towards / np.linalg.norm(towards, axis=0)).astype(np.float32)
    origins = origins.astype(np.float32)
    distance = part.shape.enter(origins, directions)
    points = (origins + np.where(np.isfinite(distance), distance, 0) * directions)[:, np.isfinite(distance)]
    normals = part.shape.normals(points)
    spread = []
    for width in (0.002, 50.0):
        appearance = part.surface.appearance(points, normals, np.full_like(points, width))
        assert np.isfinite(appearance.albedo).all()
        assert appearance.albedo.min() >= 0
        assert appearance.albedo.max() <= 1.2
        assert ((appearance.gloss >= 0) & (appearance.gloss <= 1)).all()
        top = normals[2] > 0.5
        chosen = appearance.albedo[:, ~top] if (~top).any() else appearance.albedo
        spread.append(chosen.std(1).max())
    assert spread[1] <= spread[0] + 1e-3
    nothing = part.surface.appearance(points[:, :0], normals[:, :0], points[:, :0])
    assert nothing.albedo.shape == (3, 0)
