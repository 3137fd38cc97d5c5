"""Values that training drifts into (docs/stability.md; the number in a name is the row there)."""

import dataclasses
import functools

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
    every_fast_precision,
    every_precision,
    first_interpreted,
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


# Without a pixel that two opaque splats bring to 0.01^2 = 1e-4, the default's limit, exactly: rounding would decide.
EXTREME_SETTINGS = (
    SplatSettings(transmittance_min=3e-5),
    SplatSettings(transmittance_min=3e-5, antialias=True, stop="exclusive", eps2d=0.0),
)


@pytest.mark.lengthy
@pytest.mark.slow_if_interpreted
@every_precision
def test_01_no_nan_in_extreme_scenes(backend, dtype):
    # 10,000 rows in small scenes: in large ones the opaque rows in front hide the others.
    for seed in range(100 if backend == "cpu" else 10):
        settings = EXTREME_SETTINGS[seed % 2]
        result = render(extreme_gaussians(100, seed), front_camera(19, 14, 25.0), backend, dtype, settings)
        assert result.is_finite(), (seed, settings)
        # Culled rows have exactly zero gradient.
        culled = result.radii == 0
        assert culled.any()
        assert not any(result.gradients[name][culled].any() for name in FIELDS)


@pytest.mark.lengthy
@every_fast_precision
def test_01_extreme_scenes_are_right(backend, dtype):
    # In float64 all backends agree. What float32 costs such rows depends on the scene, from nothing to all digits: the
    # same formulas as they are written, in plain float32, tell how much. A backend may lose three times that in the
    # image and ten times in the gradients, besides its own bars.
    image_bar, gradient_bar = (1e-5, 5e-4) if dtype == torch.float32 else (1e-12, 1e-6)
    view, accurate = front_camera(19, 14, 25.0), 0
    scenes, rows = (2, 25) if backend == "triton" else (10, 100)
    for seed in range(scenes):
        gaussians, settings = extreme_gaussians(rows, seed), EXTREME_SETTINGS[seed % 2]
        truth = render(gaussians, view, "reference", torch.float64, settings)
        plain = truth if dtype == torch.float64 else render(gaussians, view, "reference", dtype, settings)
        result = render(gaussians, view, backend, dtype, settings)
        for name, image in truth.images.items():
            lost, expected = ((other.images[name] - image).abs().max() / image.abs().max() for other in (result, plain))
            assert lost <= image_bar + 3 * expected, (seed, name)
            accurate += expected < image_bar
        for name, gradient in truth.gradients.items():
            lost, expected = (relative_error(other.gradients[name], gradient) for other in (result, plain))
            assert lost <= gradient_bar + 10 * expected, (seed, name)
            accurate += expected < gradient_bar
    # Of nine images and gradients.
    assert accurate > 4 * scenes


@every_backend
@pytest.mark.parametrize(
    "case", first_interpreted((1e12, False), (1e12, True), (1e25, False)), ids=lambda case: f"{case[0]:g}-{case[1]}"
)
def test_02_an_overflowing_row_is_culled(backend, case):
    # 1e12 m and 1e25 m are finite, but not the determinant of the one nor the variance of the other on the screen, in
    # float32: they must vanish, not poison their neighbors.
    size, antialias = case
    view, settings = front_camera(21, 13, 20.0), SplatSettings(antialias=antialias)
    good = random_gaussians(10, view)
    bad = one_gaussian(scales=[[size] * 3])
    both = Gaussians.concatenate([good, bad])
    alone, together = (render(scene, view, backend, torch.float32, settings) for scene in (good, both))
    for name, image in alone.images.items():
        assert torch.equal(image, together.images[name]), name
    assert together.is_finite()
    assert together.radii[-1] == 0
    assert not any(gradient[-1].any() for gradient in together.gradients.values())
    assert guards(cast(both, torch.float32), view, settings=settings).alarms == {"overflowed": 1}
    assert guards(both, view, settings=settings).alarms == {}


@every_backend
def test_02_a_row_too_far_to_square_is_culled_and_not_drawn_in_another_color(backend):
    """Beyond 1.8e19 m the length of the direction is infinite in float32, and its harmonics would count as those of no
    direction. float64 draws it, in a color that depends on where it stands."""
    view, settings = front_camera(21, 13, 20.0), SplatSettings()
    far = one_gaussian(
        means=[[3e18, -2e18, 3e19]], scales=[[4e18] * 3], sh=[[[0.3, 0.1, 0.2], *[[0.5, -0.4, 0.6]] * 3]]
    )
    both = Gaussians.concatenate([random_gaussians(10, view), far])
    alone, together = (
        render(rows, view, backend, torch.float32, settings) for rows in (random_gaussians(10, view), both)
    )
    for name, image in alone.images.items():
        assert torch.equal(image, together.images[name]), name
    assert together.radii[-1] == 0
    assert not any(gradient[-1].any() for gradient in together.gradients.values())
    assert guards(cast(both, torch.float32), view, settings=settings).alarms == {"overflowed": 1}
    assert guards(both, view, settings=settings).alarms == {}
    near = dataclasses.replace(far, means=1e-18 * far.means, scales=1e-18 * far.scales)
    if backend != "triton":  # float32 alone
        images = [render(rows, view, backend, torch.float64, settings).images["rgb"] for rows in (far, near)]
        torch.testing.assert_close(*images, rtol=0, atol=1e-12)


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
@pytest.mark.parametrize("length", [*first_interpreted(1e-44, 1e-39, 1e-35, 1e-30, 1e-19, 3.0, 1e20, 1e30), 3e38])
def test_05_length_of_quaternions_does_not_matter(backend, dtype, length):
    # Down to float32's last subnormals and up to its end. 1 / length does not fit there, so gradients end growing.
    view, eps = front_camera(21, 13, 20.0), torch.finfo(dtype).eps
    q = (torch.tensor([0.4, -0.7, 1.0, 0.5], dtype=torch.float32) * length).double()
    shape = {"scales": [[0.4, 0.1, 0.2]]}
    long = one_gaussian(quaternions=[q.tolist()], **shape)
    unit = one_gaussian(quaternions=[(q / q.norm()).tolist()], **shape)
    result, expected = (render(scene, view, backend, dtype) for scene in (long, unit))
    assert (result.images["rgb"] - expected.images["rgb"]).abs().max() < 50 * eps
    assert result.is_finite()
    gradient = result.gradients["quaternions"][0]
    assert gradient.norm() > 0 or length > 1e30
    if 1e-30 <= length <= 1e30:
        # The gradient has no part along q, and falls with its length.
        assert (gradient @ q).abs() < 100 * eps * gradient.norm() * q.norm()
        assert relative_error(gradient, expected.gradients["quaternions"][0] / q.norm()) < 1e3 * eps
    else:
        assert (gradient @ q).abs() <= 1e-4 * gradient.norm() * q.norm()


@every_precision
@pytest.mark.parametrize("antialias", first_interpreted(True, False))
@pytest.mark.parametrize("flat", [(0,), (1, 2), (0, 1, 2)])
def test_14_zero_scales(backend, dtype, antialias, flat):
    scales = [[0.0 if axis in flat else 0.2 for axis in range(3)]]
    gaussians = one_gaussian(scales=scales, quaternions=[[0.9, 0.2, -0.3, 0.1]])
    settings = SplatSettings(antialias=antialias)
    result = render(gaussians, front_camera(9, 9, 20.0), backend, dtype, settings)
    assert result.is_finite()
    truth = render(gaussians, front_camera(9, 9, 20.0), "reference", torch.float64, settings)
    bar = 1e-5 if dtype == torch.float32 else 1e-12
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < bar
    for name, gradient in truth.gradients.items():
        if gradient.any():
            assert relative_error(result.gradients[name], gradient) < 10 * bar, name
        else:  # A flat axis with compensation at its floor, or a ball: there is nothing to turn or to grow.
            assert not result.gradients[name].any(), name


@every_precision
@pytest.mark.parametrize("preset", first_interpreted("exact", "default", "fine"))
def test_14_a_masked_row_leaves_no_trace(backend, dtype, preset):
    # "exact" and "fine" draw down to an alpha of 0: there only the cull of opacity 0 itself keeps the rows out.
    view, settings = camera(21, 13), SplatSettings.preset(preset)
    gaussians = random_gaussians(18 if backend == "triton" else 60, view)
    keep = torch.arange(len(gaussians)) % 3 > 0
    without = Gaussians(*(getattr(gaussians, name)[keep] for name in FIELDS))
    masked = dataclasses.replace(
        gaussians, opacities=gaussians.opacities * keep, scales=gaussians.scales * keep[:, None]
    )
    plain, dropped = (render(scene, view, backend, dtype, settings) for scene in (without, masked))
    for name, image in plain.images.items():
        assert torch.equal(image, dropped.images[name]), name
    for name, gradient in plain.gradients.items():
        assert torch.equal(gradient, dropped.gradients[name][keep]), name
        assert not dropped.gradients[name][~keep].any(), name
    assert not dropped.radii[~keep].any()
    assert guards(cast(masked, dtype), view, settings=settings).masked == len(gaussians) // 3


@every_precision
@pytest.mark.parametrize("preset", first_interpreted("exact", "fine"))
def test_11_an_opacity_below_the_normal_numbers_is_culled(backend, dtype, preset):
    # Without a cut-off the gradient of an opacity o is a sum over o exp(..) divided by o: 0 times infinity.
    view, settings, least = front_camera(9, 9, 20.0), SplatSettings.preset(preset), 2.0**-126
    for opacity in (1e-45, 1e-40, least * (1 - 2.0**-23)):
        faint = one_gaussian(opacities=[opacity])
        result = render(faint, view, backend, dtype, settings)
        assert result.radii.tolist() == [0.0]
        assert not any(value.any() for value in (*result.images.values(), *result.gradients.values())), opacity
        assert guards(cast(faint, dtype), view, settings=settings).faint == 1
    result = render(one_gaussian(opacities=[least]), view, backend, dtype, settings)
    assert result.radii[0] > 0
    assert result.is_finite()


@every_precision
def test_25_negative_colors_are_black_without_gradient(backend, dtype):
    sh = [[[-1.5 / Y0, 0.5 / Y0, -1.5 / Y0]]]
    view = front_camera(5, 5, 40.0)
    result = render(one_gaussian(sh=sh), view, backend, dtype)
    assert guards(cast(one_gaussian(sh=sh), dtype), view).color_cut == 1
    assert result.images["rgb"].min() == 0
    assert result.gradients["sh"][0, 0, [0, 2]].tolist() == [0.0, 0.0]
    assert result.gradients["sh"][0, 0, 1] != 0


@every_backend
@pytest.mark.parametrize("half", first_interpreted(torch.float16, torch.bfloat16), ids=["float16", "bfloat16"])
def test_20_half_precision(backend, half):
    # Autocast leaves every bit of image and gradient alone; Gaussians in half precision are refused.
    view = camera(21, 13)
    gaussians = random_gaussians(18 if backend == "triton" else 60, view)
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


def _loss_of(field: str, gaussians: Gaussians, value: torch.Tensor, backend: str) -> torch.Tensor:
    """Images and depth under random cotangents, with one field replaced by ``value``."""
    view = camera(6, 5)
    fields = {other: getattr(gaussians, other).to(value) for other in FIELDS} | {field: value}
    settings = SplatSettings(alpha_min=1e-9, antialias=True)
    seen = splat(Gaussians(**fields), view, settings=settings, backend=backend)
    images = (seen.rgb, seen.alpha, seen.depth)
    weighted = ((image * weight.to(image)).sum() for image, weight in zip(images, cotangents(view), strict=True))
    return sum(weighted, torch.zeros_like(value[:0]).sum())


@functools.cache
def _differences(field: str) -> tuple[Gaussians, torch.Tensor]:
    """Rows, and central differences of their loss in each number of ``field``: good to 1e-9 of the largest."""
    gaussians = random_gaussians(4, camera(6, 5), terms=4, seed=8)
    start = getattr(gaussians, field)
    found = torch.zeros_like(start)
    for index in np.ndindex(*start.shape):
        sides = []
        for step in (1e-5, -1e-5):
            moved = start.clone()
            moved[index] += step
            sides.append(_loss_of(field, gaussians, moved, "reference"))
        found[index] = (sides[0] - sides[1]) / 2e-5
    return gaussians, found


@pytest.mark.lengthy
@every_precision
@pytest.mark.parametrize("field", FIELDS)
def test_22_every_parameter_alone(backend, dtype, field):
    # Each number of each row, the other fields without gradient: a factor that is missing from one chain shows here, in
    # one number as well: each is held to the bar in units of what the field's numbers usually have.
    gaussians, expected = _differences(field)
    value = getattr(gaussians, field).to(device_of(backend), dtype).clone().requires_grad_()
    (gradient,) = torch.autograd.grad(_loss_of(field, gaussians, value, backend), value)
    usual = expected.square().mean().sqrt()
    assert usual > 0
    assert (gradient.double().cpu() - expected).abs().max() < (1e-7 if dtype == torch.float64 else 1e-4) * usual
