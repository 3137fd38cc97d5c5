"""Values that training drifts into (docs/stability.md; the number in a name is the row there)."""

import dataclasses

import numpy as np
import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, guards, splat
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    device_of,
    every_backend,
    every_precision,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

Y0 = 0.28209479177387814


def extreme_gaussians(rows: int, seed: int) -> Gaussians:
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


@every_precision
def test_01_no_nan_in_extreme_scenes(backend, dtype):
    for seed in range(40 if backend == "cpu" else 6):
        for settings in (SplatSettings(), SplatSettings(antialias=True, stop="exclusive", blur=0.0)):
            result = render(extreme_gaussians(60, seed), front_camera(19, 14, 25.0), backend, dtype, settings)
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
    assert guards(cast(both, torch.float32), view).alarms == {"overflowed": 1}
    assert guards(both, view).alarms == {}


@every_precision
def test_05_zero_quaternion_is_the_identity(backend, dtype):
    view = front_camera(21, 13, 20.0)
    shape = {"scales": [[0.4, 0.1, 0.2]]}
    turned = one_gaussian(quaternions=[[0.0] * 4], **shape)
    zero = render(turned, view, backend, dtype)
    identity = render(one_gaussian(**shape), view, backend, dtype)
    assert torch.equal(zero.images["rgb"], identity.images["rgb"])
    assert not zero.gradients["quaternions"].any()
    assert zero.is_finite()
    assert guards(cast(turned, dtype), view).alarms == {"identity_quaternion": 1}


@every_precision
def test_05_length_of_quaternions_does_not_matter(backend, dtype):
    view = front_camera(21, 13, 20.0)
    q = torch.tensor([0.4, -0.7, 0.3, 0.5], dtype=torch.float64)
    eps = torch.finfo(dtype).eps
    unit = render(one_gaussian(quaternions=[(q / q.norm()).tolist()], scales=[[0.4, 0.1, 0.2]]), view, backend, dtype)
    for length in (1e-30, 1e-19, 1e-12, 3.0, 1e12, 1e20, 1e30):
        long = one_gaussian(quaternions=[(q * length).tolist()], scales=[[0.4, 0.1, 0.2]])
        result = render(long, view, backend, dtype)
        assert (result.images["rgb"] - unit.images["rgb"]).abs().max() < 50 * eps
        gradient = result.gradients["quaternions"][0]
        assert gradient.norm() > 0
        # The gradient has no part along q, and falls with its length.
        assert (gradient @ q).abs() < 100 * eps * gradient.norm() * q.norm()
        expected = unit.gradients["quaternions"][0] / (length * q.norm())
        assert relative_error(gradient, expected) < 1e3 * eps


@every_precision
@pytest.mark.parametrize("length", [1e-44, 1e-39, 1e-35, 3e38])
def test_05_only_zero_has_no_direction(backend, dtype, length):
    # Down to float32's last subnormals and up to its end. 1 / length does not fit there, so gradients end growing.
    view = front_camera(21, 13, 20.0)
    q = torch.tensor([0.4, -0.7, 1.0, 0.5], dtype=torch.float64).to(torch.float32) * length
    shape = {"scales": [[0.4, 0.1, 0.2]]}
    long = one_gaussian(quaternions=[q.tolist()], **shape)
    unit = one_gaussian(quaternions=[(q.double() / q.double().norm()).tolist()], **shape)
    result, expected = (render(scene, view, backend, dtype) for scene in (long, unit))
    assert (result.images["rgb"] - expected.images["rgb"]).abs().max() < 50 * torch.finfo(dtype).eps
    assert result.is_finite()
    gradient = result.gradients["quaternions"][0]
    assert gradient.norm() > 0 or length > 1
    assert (gradient @ q.double()).abs() <= 1e-4 * gradient.norm() * q.double().norm()


@every_precision
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


@every_precision
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
    assert guards(cast(masked, dtype), view).masked == 20


@every_precision
def test_25_negative_colours_are_black_without_gradient(backend, dtype):
    sh = [[[-1.5 / Y0, 0.5 / Y0, -1.5 / Y0]]]
    view = front_camera(5, 5, 40.0)
    result = render(one_gaussian(sh=sh), view, backend, dtype)
    assert guards(cast(one_gaussian(sh=sh), dtype), view).color_cut == 1
    assert result.images["rgb"].min() == 0
    assert result.gradients["sh"][0, 0, [0, 2]].tolist() == [0.0, 0.0]
    assert result.gradients["sh"][0, 0, 1] != 0


@every_backend
@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
def test_20_half_precision(backend, half):
    # Autocast leaves every bit of image and gradient alone; Gaussians in half precision are refused.
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    results, device = [], device_of(backend)
    for enabled in (False, True):
        leaves = cast(gaussians, torch.float32, requires_grad=True, device=device)
        with torch.autocast(device.type, dtype=half, enabled=enabled):
            rendering = splat(leaves, view, backend=backend, background=torch.ones(3, device=device))
        rendering.rgb.backward(cotangents(view)[0].float().to(device))
        results.append([rendering.rgb, rendering.alpha, *(getattr(leaves, name).grad for name in FIELDS)])
    assert all(torch.equal(plain, inside) for plain, inside in zip(*results, strict=True))
    for call in (splat, contribution):
        with pytest.raises(ValueError, match=f"computes in float32.*got {half}: convert"):
            call(cast(gaussians, half, device=device), view, backend=backend)


@every_precision
@pytest.mark.parametrize("field", FIELDS)
def test_22_every_parameter_alone(backend, dtype, field):
    # Each number of each row by central differences, the other fields without gradient: a factor that is missing from
    # one chain shows here. Differences of step 1e-5 are good to 1e-9 of the largest gradient.
    view = camera(6, 5)
    gaussians = random_gaussians(4, view, terms=4, seed=8)
    settings = SplatSettings(alpha_min=1e-9, antialias=True)
    cotangent = cotangents(view)

    def loss(value, name):
        fields = {other: getattr(gaussians, other).to(value) for other in FIELDS} | {field: value}
        seen = splat(Gaussians(**fields), view, settings=settings, backend=name)
        images = (seen.rgb, seen.alpha, seen.depth)
        return sum((image * weight.to(image)).sum() for image, weight in zip(images, cotangent, strict=True))

    start = getattr(gaussians, field)
    expected = torch.zeros_like(start)
    for index in np.ndindex(*start.shape):
        sides = []
        for step in (1e-5, -1e-5):
            moved = start.clone()
            moved[index] += step
            sides.append(loss(moved, "reference"))
        expected[index] = (sides[0] - sides[1]) / 2e-5
    assert (expected.reshape(4, -1).norm(dim=1) > 0).any()
    value = start.to(device_of(backend), dtype).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(value, backend), value)
    assert relative_error(gradient.double().cpu(), expected) < (1e-7 if dtype == torch.float64 else 1e-4)
