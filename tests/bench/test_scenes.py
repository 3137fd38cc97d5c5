"""The scenes are what their names say, and the same every time."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.bench.scenes import (
    _CARS,
    STACK,
    Size,
    bench_scenes,
    deep_stack,
    frustum_camera,
    frustum_gaussians,
    needles_and_giants,
    proxy_street,
    seen_through,
)
from sparsestreet.ops import SplatSettings, contribution
from sparsestreet.ops.reference import visible_rows
from tests.typed import there

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


def test_every_scene_is_another_for_another_seed():
    """The proxy of a street alone is always the same, but for what is masked of it."""
    first, other = bench_scenes(SIZE), bench_scenes(SIZE, seed=1)
    alike = [
        all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in FIELDS)
        for a, b in zip(first, other, strict=True)
    ]
    assert alike == [False, False, False, True, False]
    for make in (deep_stack, needles_and_giants):
        scales, opacities = ([getattr(make(SIZE, seed).gaussians, name) for seed in (0, 1)] for name in FIELDS[2:4])
        assert not torch.equal(*scales)
        assert not torch.equal(*opacities)
        assert torch.equal(make(SIZE).gaussians.scales, scales[0])
    masks = [one[-1].gaussians.opacities == 0 for one in (first, other)]
    assert 0.45 < float((masks[0] != masks[1]).float().mean()) < 0.55


def test_the_camera_of_a_frustum():
    camera = frustum_camera(96, 64)
    assert camera.intrinsics.tolist() == [[96, 0, 48], [0, 96, 32], [0, 0, 1]]
    assert (camera.width, camera.height) == (96, 64)
    assert torch.equal(camera.camera_from_world, torch.eye(4))


def test_a_frustum_is_filled_evenly():
    """Of 20,000 draws a mean is known to 0.7 % of the spread, a median to 1 %; four times that is allowed."""
    rows, camera = 20_000, frustum_camera(96, 64)
    found = frustum_gaussians(rows, camera, sigma_pixels=3.0, terms=4)
    depth = found.means[:, 2]
    pixels = 96 * found.means[:, :2] / depth[:, None] + torch.tensor([48.0, 32.0])
    for values, low, high in (
        (depth, 2.0, 50.0), (pixels[:, 0], 0.0, 96.0), (pixels[:, 1], 0.0, 64.0), (found.opacities, 0.05, 0.95),
    ):  # fmt: skip
        uniform = (values - low) / (high - low)
        assert -1e-4 <= float(uniform.min()) < 0.001
        assert 0.999 < float(uniform.max()) <= 1 + 1e-4
        assert float(uniform.mean()) == pytest.approx(0.5, abs=0.01)
    logs = (found.scales / depth[:, None] * 96).log()
    assert logs.mean(0).tolist() == pytest.approx([math.log(3.0)] * 3, abs=0.02)
    assert logs.std(0).tolist() == pytest.approx([0.5] * 3, rel=0.03)
    assert found.sh.shape == (rows, 4, 3)
    assert float(found.sh.std()) == pytest.approx(0.3, rel=0.02)
    assert float(found.quaternions.std()) == pytest.approx(1.0, rel=0.02)


def test_the_proxy_has_the_parts_of_a_street():
    """Three tenths road, two fifths facades, then cars, poles and what floats: where each lies, and how large it is.

    Sizes are factors of unit times distance, log-normal by 0.35; the unit is 0.9 over the root of the rows.
    """
    rows = 20_000
    street = proxy_street(rows, terms=4)
    names, shares = ("road", "facades", "cars", "poles", "adrift"), (0.3, 0.4, 0.15, 0.1, 0.05)
    ends = [round(sum(shares[: place + 1]) * rows) for place in range(5)]
    part = {name: slice(end - round(share * rows), end) for name, share, end in zip(names, shares, ends, strict=True)}
    x, y, z = street.means.unbind(1)
    factors = {"road": (1.5, 0.1, 6.0), "facades": (0.1, 1.2, 4.0), "cars": (0.7, 0.7, 0.7), "poles": (0.2, 6.0, 0.2),
               "adrift": (6.0, 6.0, 6.0)}  # fmt: skip
    unit = 0.9 / rows**0.5
    for name, expected in factors.items():
        logs = (street.scales[part[name]] / (unit * z[part[name], None])).log()
        # 1,000 to 8,000 rows: four times 0.35 / sqrt(1000).
        assert logs.mean(0).tolist() == pytest.approx([math.log(one) for one in expected], abs=0.045), name
        assert logs.std(0).tolist() == pytest.approx([0.35] * 3, rel=0.1), name
    for name in ("road", "facades", "adrift"):
        depth = z[part[name]]
        assert (float(depth.min()) >= 3.0 - 1e-4, float(depth.max()) <= 70.0 + 1e-3) == (True, True)
        assert float(depth.log().mean()) == pytest.approx(math.log(210) / 2, abs=0.12)  # log-uniform
    assert bool((y[part["road"]] == 1.6).all())
    spans = {("road", 0): (-9, 9), ("facades", 1): (-12, 1.6), ("poles", 1): (-5, 1.6), ("adrift", 1): (-6, 1)}
    for (name, axis), (low, high) in spans.items():
        values = street.means[part[name], axis]
        assert (float(values.min()), float(values.max())) == pytest.approx((low, high), abs=0.05), (name, axis)
    sides = {name: set(x[part[name]].tolist()) for name in ("facades", "poles")}
    assert sides == {"facades": {-9.5, 9.5}, "poles": {-6.5, 6.5}}
    assert sorted(set(z[part["poles"]].tolist())) == [5.0 + 8 * place for place in range(8)]
    slope = (x / z)[part["adrift"]]
    assert (float(slope.min()), float(slope.max())) == pytest.approx((-0.6, 0.6), abs=0.01)
    # Each car's splats lie on the surface of its box, 1.8 x 1.5 x 4.2 m.
    centers = torch.tensor([(cx, 0.85, cz) for cx, cz in _CARS])
    offsets = (street.means[part["cars"], None] - centers) / torch.tensor([0.9, 0.75, 2.1])
    largest = offsets.abs().amax(2).amin(1)
    assert largest.tolist() == pytest.approx([1.0] * len(largest), abs=1e-4)
    met = offsets.abs().amax(2).argmin(1).bincount(minlength=6) / len(largest)
    assert met.tolist() == pytest.approx([1 / 6] * 6, abs=0.03)
    solid = street.opacities[: ends[3]]
    assert float((solid > 0.5).float().mean()) == pytest.approx(0.67, abs=0.02)
    assert (float(solid.min()), float(solid.max())) == pytest.approx((0.02, 0.99), abs=0.001)
    assert bool(((solid < 0.4) | (solid > 0.6)).all())
    faint = street.opacities[part["adrift"]]
    assert (float(faint.min()), float(faint.max())) == pytest.approx((0.01, 0.15), abs=0.002)
    colors = street.sh[:, 0] / (4 * math.pi) ** 0.5 + 0.5
    ranges = {
        "road": (0.2, 0.4),
        "cars": (0.1, 0.9),
        "facades": (0.3, 0.8),
        "poles": (0.05, 0.25),
        "adrift": (0.4, 0.7),
    }
    for name, (low, high) in ranges.items():
        some = colors[part[name]]
        assert low - 1e-4 <= float(some.min()) <= float(some.max()) <= high + 1e-4, name
    assert float(street.sh[:, 1:].std()) == pytest.approx(0.05, rel=0.03)
    assert bool((street.quaternions[:, 0] == 1).all())
    assert float(street.quaternions[:, 1:].std()) == pytest.approx(0.03, rel=0.03)


@pytest.mark.parametrize(("name", "bent", "rolling"), [("off", 0, 0), ("lens", 1, 0), ("shutter", 0, 1),
                                                      ("lens and shutter", 1, 1)])  # fmt: skip
def test_effects_take_the_place_of_the_cameras_own(name, bent, rolling):
    scene = bench_scenes(SIZE)[0]
    own = replace(scene, camera=replace(scene.camera, distortion=torch.ones(5)))
    seen = seen_through(own, name)
    lens, shutter = seen.camera.distortion, seen.camera.shutter
    assert (lens is not None, shutter is not None, seen.gaussians.displacements is not None) == (
        bool(bent), bool(rolling), bool(rolling),
    )  # fmt: skip
    if lens is not None:
        assert lens.tolist() == pytest.approx([-0.05, 0.01, 5e-4, -5e-4, 0.0])
    if shutter is not None:
        assert shutter.translation.tolist() == pytest.approx([0.0, 0.0, 0.3])
        assert shutter.rotation.tolist() == pytest.approx([0.0, 0.01, 0.0])
        walk = there(seen.gaussians.displacements)
        assert float(walk.std()) == pytest.approx(0.05, rel=0.05)
        assert torch.equal(walk, there(seen_through(own, name).gaussians.displacements))
    assert torch.equal(seen.gaussians.means, scene.gaussians.means)
    assert seen_through(own, None) is own
