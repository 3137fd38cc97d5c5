"""Inputs on which splatting is known to break, on every backend: finite, right, and repeatable (docs/stability.md)."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.cpu.workspace import idle_workspaces
from sparsestreet.ops.reference import projection
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

every_backend = pytest.mark.parametrize("backend", ["reference", "cpu"])
every_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
Y0 = 0.28209479177387814


def _extreme_gaussians(rows: int, seed: int) -> Gaussians:
    """Values over the whole range that float32 training can drift into; a third of them at the very edges."""
    rng = np.random.default_rng(seed)

    def spread(*shape: int, low: float, high: float) -> np.ndarray:
        return 10.0 ** rng.uniform(low, high, shape)

    depth = np.where(rng.random(rows) < 0.3, 0.2 + spread(rows, low=-7, high=-3), spread(rows, low=-2, high=4))
    sides = rng.normal(size=(rows, 2)) * depth[:, None]
    scales = np.where(rng.random((rows, 3)) < 0.1, 0.0, spread(rows, 3, low=-12, high=6))
    quaternions = rng.normal(size=(rows, 4)) * spread(rows, 1, low=-22, high=8)
    opacities = np.where(rng.random(rows) < 0.4, rng.choice([0.0, 1.0, 1 / 255, 1e-8]), rng.random(rows))
    sh = rng.normal(size=(rows, 4, 3)) * spread(rows, 1, 1, low=-3, high=3)
    parts = (np.concatenate((sides, depth[:, None]), -1), quaternions, scales, opacities, sh)
    return Gaussians(*(torch.tensor(part, dtype=torch.float32).double() for part in parts))


@every_backend
@every_dtype
def test_01_no_nan_in_extreme_scenes(backend, dtype):
    for seed in range(40 if backend == "cpu" else 6):
        for settings in (SplatSettings(), SplatSettings(antialias=True, stop="exclusive", blur=0.0)):
            result = render(_extreme_gaussians(60, seed), front_camera(19, 14, 25.0), backend, dtype, settings)
            assert result.is_finite(), (seed, settings)
            # Culled rows have exactly zero gradient.
            culled = result.radii == 0
            assert culled.any()
            assert not any(result.gradients[name][culled].any() for name in FIELDS)


@every_backend
def test_02_an_overflowing_row_is_culled(backend):
    # 1e25 m is finite, but its variance on the screen is not, in float32: it must vanish, not poison its neighbours.
    view = front_camera(21, 13, 20.0)
    good = random_gaussians(30, view)
    bad = one_gaussian(scales=[[1e25, 1e25, 1e25]])
    both = Gaussians.concatenate([good, bad])
    alone, together = (render(scene, view, backend, torch.float32) for scene in (good, both))
    assert torch.equal(alone.images["rgb"], together.images["rgb"])
    assert together.is_finite()
    assert together.radii[-1] == 0


@pytest.mark.parametrize("length", [200.0, 1000.0, 5000.0])
def test_03_determinant_of_needles(length):
    # A needle `length` px long and 1e-3 px thin, turned by 0.7 rad: xx yy - xy^2 would lose all digits in float32.
    turn = torch.tensor([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]], dtype=torch.float64)
    factors = torch.zeros(1, 2, 3, dtype=torch.float64)
    factors[0, :, :2] = turn @ torch.diag(torch.tensor([length, 1e-3], dtype=torch.float64))
    factors = factors.float()
    single = projection._determinants(factors, 0.3)[0]
    double = projection._determinants(factors.double(), 0.3)[0]
    assert single > 0
    assert relative_error(single.double(), double) < 1e-6


@every_backend
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_03_04_needles_in_float32(backend, ratio):
    # From the thin side's blur (0.55 px) to 1e6 times the thickness; q >= 0 keeps alpha <= opacity.
    view = front_camera(48, 40, 40.0)
    needle = one_gaussian(
        quaternions=[[0.93, 0.05, -0.02, 0.36]], scales=[[1e-4 * ratio, 1e-4, 1e-4]], means=[[0.2, -0.1, 2.0]]
    )
    truth = render(needle, view, "reference", torch.float64)
    result = render(needle, view, backend, torch.float32)
    assert result.images["alpha"].max() <= 0.8 * (1 + 1e-6)
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
    # The scales' gradient of the shortest needle is a difference of large terms, in any backend; 1e6 is 2000 px long:
    # there sums of whitened moments lose the quaternion's gradient (3e-2), sums towards the Cholesky factor keep it.
    bar = 3e-4 if ratio == 1e2 else 1e-4
    for name in FIELDS:
        assert relative_error(result.gradients[name], truth.gradients[name]) < bar, name


@every_backend
def test_04_exponent_far_along_a_needle(backend):
    # 350 px from the centre the conic form subtracts terms of 1e5 to find a squared distance below 10.
    view = front_camera(512, 512, 400.0)
    needle = one_gaussian(quaternions=[[0.93, 0.05, -0.02, 0.36]], scales=[[10.0, 1e-4, 1e-4]])
    truth = splat(needle, view, backend="reference")
    alpha = splat(cast(needle, torch.float32), view, backend=backend).alpha
    assert (truth.alpha[:64] > 0.5).any()
    # The difference l11 dx + l21 dy keeps 300 * 6e-8 of a standard deviation; the profile changes by 1 in one.
    assert (alpha - truth.alpha).abs().max() < 2e-4


@every_backend
@every_dtype
def test_05_zero_quaternion_is_the_identity(backend, dtype):
    view = front_camera(21, 13, 20.0)
    shape = {"scales": [[0.4, 0.1, 0.2]]}
    zero = render(one_gaussian(quaternions=[[0.0] * 4], **shape), view, backend, dtype)
    identity = render(one_gaussian(**shape), view, backend, dtype)
    assert torch.equal(zero.images["rgb"], identity.images["rgb"])
    assert not zero.gradients["quaternions"].any()
    assert zero.is_finite()


@every_backend
@every_dtype
def test_05_length_of_quaternions_does_not_matter(backend, dtype):
    view = front_camera(21, 13, 20.0)
    q = torch.tensor([0.4, -0.7, 0.3, 0.5], dtype=torch.float64)
    eps = torch.finfo(dtype).eps
    unit = render(one_gaussian(quaternions=[(q / q.norm()).tolist()], scales=[[0.4, 0.1, 0.2]]), view, backend, dtype)
    for length in (1e-12, 3.0, 1e12):
        long = one_gaussian(quaternions=[(q * length).tolist()], scales=[[0.4, 0.1, 0.2]])
        result = render(long, view, backend, dtype)
        assert (result.images["rgb"] - unit.images["rgb"]).abs().max() < 50 * eps
        gradient = result.gradients["quaternions"][0]
        assert gradient.norm() > 0
        # The gradient has no part along q, and falls with its length.
        assert (gradient @ q).abs() < 100 * eps * gradient.norm() * q.norm()
        expected = unit.gradients["quaternions"][0] / (length * q.norm())
        assert relative_error(gradient, expected) < 1e3 * eps


@every_backend
@every_dtype
def test_06_through_the_near_plane(backend, dtype):
    view = front_camera(21, 13, 20.0)
    depths = [0.2 - 1e-3, 0.2, 0.2 + 1e-6, 0.2 + 1e-3, 0.21, 0.25, 0.5]
    seen = []
    for depth in depths:
        result = render(one_gaussian(means=[[0.01, 0.02, depth]]), view, backend, dtype)
        assert result.is_finite()
        seen.append(bool(result.radii[0] > 0))
    assert seen == [False, False, True, True, True, True, True]
    near, nearer = (
        render(one_gaussian(means=[[0.01, 0.02, depth]]), view, backend, dtype) for depth in (0.25, 0.25 + 1e-6)
    )
    assert (near.images["rgb"] - nearer.images["rgb"]).abs().max() < 1e-4


@every_backend
@every_dtype
def test_06_camera_inside_a_splat(backend, dtype):
    view = front_camera(21, 13, 20.0)
    assert render(one_gaussian(means=[[0.0, 0.0, 0.0]], scales=[[3.0] * 3]), view, backend, dtype).is_finite()
    assert render(one_gaussian(means=[[0.0, 0.0, 0.3]], scales=[[3.0] * 3]), view, backend, dtype).is_finite()


@every_backend
@every_dtype
def test_10_one_opaque_splat_is_drawn(backend, dtype):
    result = render(one_gaussian(opacities=[1.0]), front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["alpha"][2, 2] == pytest.approx(0.99, rel=1e-6)
    # Exclusive stop with a limit above 0.01 drops it: that is why the default is inclusive.
    settings = SplatSettings(stop="exclusive", transmittance_min=0.02)
    assert (
        render(one_gaussian(opacities=[1.0]), front_camera(1, 1, 40.0), backend, dtype, settings).images["alpha"] == 0
    )


@every_backend
@every_dtype
def test_10_a_clamped_alpha_has_no_gradient(backend, dtype):
    # In a single pixel at the peak, alpha = 1 is clamped to 0.99: opacity and shape cannot change the image.
    result = render(one_gaussian(opacities=[1.0]), front_camera(1, 1, 40.0), backend, dtype)
    assert not any(result.gradients[name].any() for name in ("opacities", "scales", "quaternions", "screen"))
    assert result.gradients["sh"].all()


@every_backend
@every_dtype
def test_11_12_opacity_at_the_cut_off(backend, dtype):
    view = front_camera(5, 5, 40.0)
    edge = torch.tensor(1 / 255, dtype=dtype)
    below = float(torch.nextafter(edge, torch.zeros_like(edge)))
    for opacity in (0.0, 1e-8, 0.0035, below):
        result = render(one_gaussian(opacities=[opacity]), view, backend, dtype)
        assert result.radii[0] == 0, opacity
        assert not result.images["alpha"].any()
        assert not any(gradient.any() for gradient in result.gradients.values())
    at_edge = render(one_gaussian(opacities=[float(edge)]), view, backend, dtype)
    assert at_edge.is_finite()
    assert at_edge.radii[0] >= 0


@every_backend
def test_13_antialias_of_tiny_splats(backend):
    # Scales of 1e-6 m two metres ahead: det / det_blurred = 2e-18, far below where float32 has correct digits.
    view = front_camera(5, 5, 40.0)
    settings = SplatSettings(antialias=True, alpha_min=1e-6)
    for scale in (1e-2, 1e-4, 1e-6, 1e-20, 0.0):
        ball = one_gaussian(scales=[[scale] * 3])
        truth = render(ball, view, "reference", torch.float64, settings)
        result = render(ball, view, backend, torch.float32, settings)
        assert result.is_finite(), scale
        assert (result.images["alpha"] - truth.images["alpha"]).abs().max() < 1e-5
        # 20 px/m: sigma = 20 scale; ratio = (sigma^2 / (sigma^2 + 0.3))^2, with floor 0.005^2.
        factor = max(0.005, (20 * scale) ** 2 / ((20 * scale) ** 2 + 0.3))
        assert float(result.images["alpha"][2, 2]) == pytest.approx(0.8 * factor, rel=1e-5)
        # Of the colours alone: depth divides by alpha = 1 - T, and this cut-off lets through alphas of 1e-6.
        gradients = []
        for name, dtype in (("reference", torch.float64), (backend, torch.float32)):
            leaves = cast(ball, dtype, requires_grad=True)
            splat(leaves, view, settings=settings, backend=name).rgb.backward(cotangents(view)[0].to(dtype))
            gradients.append(leaves.scales.grad.double())
        assert relative_error(gradients[1], gradients[0]) < 1e-4 or not gradients[0].any()


@every_backend
@every_dtype
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("flat", [(0,), (1, 2), (0, 1, 2)])
def test_14_zero_scales(backend, dtype, antialias, flat):
    scales = [[0.0 if axis in flat else 0.2 for axis in range(3)]]
    gaussians = one_gaussian(scales=scales, quaternions=[[0.9, 0.2, -0.3, 0.1]])
    settings = SplatSettings(antialias=antialias)
    result = render(gaussians, front_camera(9, 9, 20.0), backend, dtype, settings)
    assert result.is_finite()
    truth = render(gaussians, front_camera(9, 9, 20.0), "reference", torch.float64, settings)
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5


@every_backend
@every_dtype
def test_14_a_masked_row_leaves_no_trace(backend, dtype):
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    keep = torch.arange(60) % 3 > 0
    without = Gaussians(*(getattr(gaussians, name)[keep] for name in FIELDS))
    masked = dataclasses.replace(
        gaussians, opacities=gaussians.opacities * keep, scales=gaussians.scales * keep[:, None]
    )
    plain, dropped = (render(scene, view, backend, dtype) for scene in (without, masked))
    for name, image in plain.images.items():
        if backend == "cpu":
            assert torch.equal(image, dropped.images[name])
        # The reference's matrix products may sum in another order for another number of rows.
        torch.testing.assert_close(image, dropped.images[name], rtol=1e-6, atol=1e-6)
    assert dropped.is_finite()
    assert not dropped.gradients["opacities"][~keep].any()


@every_backend
@every_dtype
@pytest.mark.parametrize("width_height", [(1, 1), (17, 9)])
def test_15_nothing_to_draw(backend, dtype, width_height):
    view = front_camera(*width_height, 20.0)
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    for gaussians in (random_gaussians(0, view), one_gaussian(means=[[0.0, 0.0, -2.0]])):
        result = render(gaussians, view, backend, dtype, background=background)
        behind = background.to(dtype).double().expand_as(result.images["rgb"])
        assert torch.equal(result.images["rgb"], behind)
        assert not result.images["alpha"].any()
        assert not result.images["depth"].any()
        assert result.is_finite()
        assert all(result.gradients[name].shape == getattr(gaussians, name).shape for name in FIELDS)
        assert result.gradients["background"].all()


@pytest.mark.parametrize("settings", [SplatSettings(), SplatSettings(stop="exclusive")], ids=["inclusive", "exclusive"])
def test_16_nothing_is_read_before_it_is_written(settings, monkeypatch):
    # Every buffer of the library and every tensor it fills starts as NaN; many tiles stay empty, many end early.
    view = camera(75, 53)
    gaussians = random_gaussians(300, view)
    opaque = one_gaussian(scales=[[90.0] * 3], opacities=[1.0], means=[[0.0, 0.0, 1.0]])
    scene = Gaussians.concatenate([gaussians, opaque, opaque, opaque])
    expected = render(scene, view, "cpu", torch.float32, settings)
    for workspace in idle_workspaces():
        workspace.poison()

    def poisoned(like):
        return lambda *args, **kwargs: like(*args, **kwargs).fill_(float("nan"))

    monkeypatch.setattr(torch.Tensor, "new_empty", poisoned(torch.Tensor.new_empty))
    monkeypatch.setattr(torch, "empty_like", poisoned(torch.empty_like))
    result = render(scene, view, "cpu", torch.float32, settings)
    for part in ("images", "gradients"):
        for name, value in getattr(expected, part).items():
            assert torch.equal(value, getattr(result, part)[name]), name


@every_backend
@every_dtype
def test_17_depth_ties_keep_the_row_order(backend, dtype):
    view = front_camera(5, 5, 40.0)
    red, green = [[[1.0 / Y0, 0.0, 0.0]]], [[[0.0, 1.0 / Y0, 0.0]]]
    first, second = one_gaussian(sh=red), one_gaussian(sh=green)
    for front, back, channel in ((first, second, 0), (second, first, 1)):
        centre = render(Gaussians.concatenate([front, back]), view, backend, dtype).images["rgb"][2, 2]
        # 0.8 (0.5 + 1) + 0.2 * 0.8 * 0.5 in the front one's channel.
        assert centre[channel] == pytest.approx(1.28, rel=1e-6)


@every_backend
@every_dtype
def test_17_neighbouring_depths_are_told_apart(backend, dtype):
    far = torch.tensor(731.25, dtype=dtype)
    depths = (float(torch.nextafter(far, 2 * far)), float(far))
    parts = [
        one_gaussian(sh=[[[1.0 / Y0, 0.0, 0.0]]], means=[[0.0, 0.0, depths[0]]], scales=[[90.0] * 3]),
        one_gaussian(sh=[[[0.0, 1.0 / Y0, 0.0]]], means=[[0.0, 0.0, depths[1]]], scales=[[90.0] * 3]),
    ]
    centre = render(Gaussians.concatenate(parts), front_camera(5, 5, 40.0), backend, dtype).images["rgb"][2, 2]
    assert centre[1] == pytest.approx(1.28, rel=1e-5)


@every_backend
def test_17_the_order_of_rows_does_not_matter_without_ties(backend):
    view = camera(37, 29)
    gaussians = random_gaussians(200, view)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    shuffled = Gaussians(*(getattr(gaussians, name)[order] for name in FIELDS))
    plain, other = (render(scene, view, backend, torch.float32) for scene in (gaussians, shuffled))
    assert torch.equal(plain.images["rgb"], other.images["rgb"])
    for name in FIELDS:
        torch.testing.assert_close(plain.gradients[name][order], other.gradients[name], rtol=1e-5, atol=1e-7)


@every_backend
def test_18_two_runs_are_bitwise_equal(backend):
    view = camera(37, 29)
    gaussians = random_gaussians(300, view)
    first, second = (render(gaussians, view, backend, torch.float32) for _ in range(2))
    for part in ("images", "gradients"):
        for name, value in getattr(first, part).items():
            assert torch.equal(value, getattr(second, part)[name]), name


@every_backend
@every_dtype
def test_24_expected_depth_of_a_faint_splat(backend, dtype):
    result = render(one_gaussian(opacities=[0.5]), front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["alpha"][2, 2] == pytest.approx(0.5, rel=1e-6)
    assert result.images["rgb"][2, 2].tolist() == pytest.approx([0.25] * 3, rel=1e-6)
    assert result.images["depth"][2, 2] == pytest.approx(2.0, rel=1e-6)
    corner = render(one_gaussian(scales=[[1e-3] * 3]), front_camera(5, 5, 40.0), backend, dtype)
    assert corner.images["depth"][0, 0] == 0


@every_backend
@every_dtype
def test_25_negative_colours_are_black_without_gradient(backend, dtype):
    sh = [[[-1.5 / Y0, 0.5 / Y0, -1.5 / Y0]]]
    result = render(one_gaussian(sh=sh), front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["rgb"].min() == 0
    assert result.gradients["sh"][0, 0, [0, 2]].tolist() == [0.0, 0.0]
    assert result.gradients["sh"][0, 0, 1] != 0


@pytest.mark.parametrize("opacities", [(0.02, 0.3), (0.9, 1.0)], ids=["translucent", "opaque"])
def test_26_deep_stacks(opacities):
    # 400 splats in every pixel; transmittance falls to 1e-30 where nothing stops it.
    generator = torch.Generator().manual_seed(4)
    n, low, high = 400, *opacities

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 2 + uniform(n)
    means = torch.stack(((uniform(n) - 0.5) * 0.2, (uniform(n) - 0.5) * 0.2, depth), -1)
    parts = (
        means,
        uniform(n, 4) - 0.5,
        0.4 + 0.4 * uniform(n, 3),
        low + (high - low) * uniform(n),
        uniform(n, 4, 3) - 0.5,
    )
    gaussians = Gaussians(*(part.float().double() for part in parts))
    view = front_camera(8, 8, 10.0)
    # The light behind a splat is the pixel's total minus a prefix: its error, 1e-7 of the total, meets
    # alpha / (1 - alpha) <= 99 and does not fall with the transmittance. Dividing T out again would give 1e-3.
    for settings, bar in ((SplatSettings(), 3e-5), (SplatSettings(transmittance_min=0.0), 1e-4)):
        truth = render(gaussians, view, "reference", torch.float64, settings)
        result = render(gaussians, view, "cpu", torch.float32, settings)
        assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
        for name in FIELDS:
            assert relative_error(result.gradients[name], truth.gradients[name]) < bar, name


@every_backend
@every_dtype
def test_27_exponents_that_underflow(backend, dtype):
    # No cut-off: pixels 1e4 standard deviations away evaluate exp(-1e8) = 0, forward and backward.
    settings = dataclasses.replace(SplatSettings.preset("exact"), blur=1e-5)
    tiny = one_gaussian(scales=[[1e-12] * 3])
    result = render(tiny, front_camera(101, 1, 40.0), backend, dtype, settings)
    assert result.is_finite()
    assert result.images["alpha"][0, 0] == 0
    assert result.images["alpha"][0, 50] == pytest.approx(0.8, rel=1e-6)
