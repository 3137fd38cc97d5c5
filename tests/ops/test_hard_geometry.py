"""Shapes and places that break the projection (docs/stability.md; the number in a name is the row there)."""

import math

import pytest
import torch

from sparsestreet.ops import SplatSettings, guards, splat
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import (
    FIELDS,
    cast,
    cotangents,
    device_of,
    every_backend,
    every_precision,
    first_interpreted,
    front_camera,
    one_gaussian,
    relative_error,
    render,
)


@every_precision
@pytest.mark.parametrize("angle", first_interpreted(0.7, 0.0, 0.3, 1.5, 2.4))
@pytest.mark.parametrize("length", [200.0, 1000.0, 5000.0])
def test_03_determinant_of_needles(backend, dtype, length, angle):
    # A flat needle `length` x 0.3 px parallel to the image, seen in the one pixel of its mean: there antialias leaves
    # opacity times sqrt(det / det_blurred), by hand. xx yy - xy^2 would lose all digits of det in float32.
    thin, blur = 0.3, 0.3
    needle = one_gaussian(
        means=[[0.0, 0.0, 1.0]],
        scales=[[length / 100, thin / 100, 0.0]],
        quaternions=[[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]],
    )
    settings = SplatSettings(antialias=True)
    alpha = render(needle, front_camera(1, 1, 100.0), backend, dtype, settings).images["alpha"]
    expected = 0.8 * length * thin / math.sqrt((length**2 + blur) * (thin**2 + blur))
    assert float(alpha[0, 0]) == pytest.approx(expected, rel=1e-6 if dtype == torch.float32 else 1e-12)


NEEDLES = {
    "flat": [0.93, 0.05, -0.02, 0.36],
    "upright": [0.7, 0.03, 0.04, 0.71],
    "towards the camera": [0.9, 0.1, -0.4, 0.2],
    "along": [1.0, 0.0, 0.0, 0.0],
}


@every_backend
@pytest.mark.parametrize("orientation", first_interpreted(*NEEDLES))
@pytest.mark.parametrize("ratio", first_interpreted(1e6, 1e4, 1e2))
def test_03_04_needles_in_float32(backend, ratio, orientation):
    # From the thin side's blur (0.55 px) to 1e6 times the thickness; q >= 0 keeps alpha <= opacity.
    view = front_camera(48, 40, 40.0)
    needle = one_gaussian(
        quaternions=[NEEDLES[orientation]], scales=[[1e-4 * ratio, 1e-4, 1e-4]], means=[[0.2, -0.1, 2.0]]
    )
    truth = render(needle, view, "reference", torch.float64)
    result = render(needle, view, backend, torch.float32)
    assert result.images["alpha"].max() <= 0.8 * (1 + 1e-6)
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
    # The scales' gradient of the shortest flat needle is a difference of large terms, in any backend; 1e6 is 2000 px
    # long: there sums of whitened moments lose the quaternion's gradient (3e-2), sums towards the Cholesky factor keep
    # it.
    bar = 3e-4 if (ratio, orientation) == (1e2, "flat") else 1e-4
    for name in FIELDS:
        assert relative_error(result.gradients[name], truth.gradients[name]) < bar, name


@pytest.mark.parametrize("length", [1e-2, 1e-1])
def test_04_needles_in_any_direction(length):
    # The scales' gradient of some needles nearly vanishes, so that their relative error has no bound; against what such
    # needles usually have, the error is small for all of them. What is left is the rounding of the mean: 2e-6 px at
    # pixel 28, times a slope of alpha of up to 5 per pixel.
    view, errors, norms = front_camera(48, 40, 40.0), [], []
    for seed in range(24):
        generator = torch.Generator().manual_seed(seed)
        needle = one_gaussian(
            quaternions=[torch.randn(4, generator=generator).tolist()],
            scales=torch.tensor([[length, 1e-4, 1e-4]], dtype=torch.float32).double().tolist(),
            means=torch.tensor([[0.2, -0.1, 2.0]], dtype=torch.float32).double().tolist(),
            opacities=[0.75],
        )
        truth, result = (render(needle, view, "cpu", dtype) for dtype in (torch.float64, torch.float32))
        errors.append(float((result.gradients["scales"] - truth.gradients["scales"]).norm()))
        norms.append(float(truth.gradients["scales"].norm()))
    assert max(errors) < 4e-5 * sorted(norms)[len(norms) // 2]


@pytest.mark.slow_if_interpreted
@every_backend
def test_04_exponent_far_along_a_needle(backend):
    # 350 px from the center the conic form subtracts terms of 1e5 to find a squared distance below 10.
    view = front_camera(512, 512, 400.0)
    needle = one_gaussian(quaternions=[[0.93, 0.05, -0.02, 0.36]], scales=[[10.0, 1e-4, 1e-4]])
    truth = splat(needle, view, backend="reference")
    alpha = render(needle, view, backend, torch.float32).images["alpha"]
    assert (truth.alpha[:64] > 0.5).any()
    # The difference l11 dx + l21 dy keeps 300 * 6e-8 of a standard deviation; the profile changes by 1 in one.
    assert (alpha - truth.alpha).abs().max() < 2e-4


@pytest.mark.slow_if_interpreted
@every_precision
def test_06_through_the_near_plane(backend, dtype):
    view = front_camera(21, 13, 20.0)
    depths = [0.2 - 1e-3, 0.2, 0.2 + 1e-6, 0.2 + 1e-3, 0.21, 0.25, 0.5]
    seen = []
    for depth in depths:
        ball = one_gaussian(means=[[0.01, 0.02, depth]])
        result = render(ball, view, backend, dtype)
        assert result.is_finite()
        seen.append(bool(result.radii[0] > 0))
        assert guards(cast(ball, dtype), view).near == (not seen[-1])
    assert seen == [False, False, True, True, True, True, True]
    near, nearer = (
        render(one_gaussian(means=[[0.01, 0.02, depth]]), view, backend, dtype) for depth in (0.25, 0.25 + 1e-6)
    )
    assert (near.images["rgb"] - nearer.images["rgb"]).abs().max() < 1e-4


@every_precision
@pytest.mark.parametrize("depth", [0.0, 0.3])
def test_06_camera_inside_a_splat(backend, dtype, depth):
    view = front_camera(21, 13, 20.0)
    assert render(one_gaussian(means=[[0.0, 0.0, depth]], scales=[[3.0] * 3]), view, backend, dtype).is_finite()


@every_backend
@pytest.mark.parametrize("scale", [0.018, *first_interpreted(1e-6, 1e-4, 1e-2, 0.0, 1e-20, 4.4e-3, 8.1e-3)])
def test_13_antialias_of_tiny_splats(backend, scale):
    """A ball's alpha at its mean is 0.8 of the compensation, and its size's gradient that of the float64 reference.

    1e-6 m two meters ahead: det / det_blurred = 2e-18, far below where float32 has correct digits."""
    view = front_camera(5, 5, 40.0)
    settings = SplatSettings(antialias=True, alpha_min=1e-6)
    # 20 px/m: sigma = 20 scale; ratio = (sigma^2 / (sigma^2 + 0.3))^2, with floor 0.005^2.
    factor = max(0.005, (20 * scale) ** 2 / ((20 * scale) ** 2 + 0.3))
    ball = one_gaussian(scales=[[scale] * 3])
    truth = render(ball, view, "reference", torch.float64, settings)
    result = render(ball, view, backend, torch.float32, settings)
    assert result.is_finite()
    assert (result.images["alpha"] - truth.images["alpha"]).abs().max() < 1e-6
    assert float(result.images["alpha"][2, 2]) == pytest.approx(0.8 * factor, rel=1e-5)
    assert guards(ball, view, settings=settings).compensation_held == (factor == 0.005)
    # Of the colors alone: depth divides by alpha = 1 - T, and this cut-off lets through alphas of 1e-6.
    gradients = []
    for name, dtype in (("reference", torch.float64), (backend, torch.float32)):
        device = device_of(name)
        leaves = cast(ball, dtype, requires_grad=True, device=device)
        splat(leaves, view, settings=settings, backend=name).rgb.backward(cotangents(view)[0].to(device, dtype))
        gradients.append(leaves.scales.grad.double().cpu())
    # At a size of 0 the variance has no slope.
    assert gradients[0].any() == (scale > 0)
    assert (gradients[1] - gradients[0]).norm() <= 1e-4 * gradients[0].norm()


@every_precision
@pytest.mark.parametrize("slope", first_interpreted(0.66, 0.64), ids=["past", "before"])
def test_07_gradients_on_both_sides_of_the_jacobian_limit(backend, dtype, slope):
    # 20 px wide at focal 20: half the field of view is 0.5, the limit 0.65. Large enough to reach the image from there.
    view = front_camera(20, 16, 20.0)
    settings = SplatSettings(alpha_min=1e-9)
    shape = {"scales": [[0.7, 0.5, 0.6]], "quaternions": [[0.9, 0.3, 0.2, 0.1]]}
    beside = one_gaussian(means=[[2 * slope, 1.4 * slope, 2.0]], **shape)
    truth = render(beside, view, "reference", settings=settings)
    assert (truth.images["rgb"] > 0.05).any()
    assert guards(cast(beside, dtype), view, settings=settings).slope_held == (slope > 0.65)
    if dtype == torch.float32:
        result = render(beside, view, backend, dtype, settings)
    for field in ("means", "quaternions", "scales"):
        values = {name: getattr(beside, name).clone() for name in FIELDS}

        def image(value, field=field, values=values):
            return splat(Gaussians(**(values | {field: value})), view, settings=settings, backend=backend).rgb

        if dtype == torch.float64:
            assert torch.autograd.gradcheck(image, values[field].requires_grad_(), fast_mode=True)
        else:
            assert relative_error(result.gradients[field], truth.gradients[field]) < 1e-4


@pytest.mark.slow_if_interpreted
@every_precision
def test_07_the_limit_acts_and_is_continuous(backend, dtype):
    # Past the limit only the Jacobian stays behind: the image goes on without a step, but not as without a limit.
    view = front_camera(20, 16, 20.0)
    wide = Camera(view.camera_from_world, view.intrinsics, 60, 16)

    def strip(slope: float, seen: Camera) -> torch.Tensor:
        ball = one_gaussian(means=[[2 * slope, 0.0, 2.0]], scales=[[0.5] * 3])
        return render(ball, seen, backend, dtype, SplatSettings(alpha_min=1e-9)).images["rgb"][:, :20]

    assert (strip(0.65 - 1e-7, view) - strip(0.65 + 1e-7, view)).abs().max() < 1e-6
    # The wider image of the same camera has a wider limit, (60 - 10) / 20 + 0.3 * 1.5.
    assert (strip(0.6, view) - strip(0.6, wide)).abs().max() < 1e-7
    assert (strip(0.8, view) - strip(0.8, wide)).abs().max() > 1e-3


@every_precision
@pytest.mark.parametrize("axis", first_interpreted(0, 1))
def test_21_brightness_of_a_sub_pixel_splat(backend, dtype, axis):
    # Sigma 0.05 px moves over a pixel. Its light is that of its own ellipse, o 2 pi sigma^2, wherever it is: pixel sums
    # of the blurred splat (sigma 0.55) are constant to 2 exp(-2 pi^2 0.3025) = 0.5 % along one axis; along the other it
    # stays a quarter off a pixel center, where they have no error.
    view = front_camera(11, 11, 20.0)
    settings = SplatSettings(antialias=True, alpha_min=1e-5)

    def brightness(ball: Gaussians, settings: SplatSettings) -> float:
        leaves = cast(ball, dtype, device=device_of(backend))
        return float(splat(leaves, view, settings=settings, backend=backend).alpha.sum())

    light, plain = [], []
    for step in torch.linspace(0, 1, 5).tolist():
        place = [0.25 * 2 / 20, 0.25 * 2 / 20, 2.0]
        place[axis] = step * 2 / 20
        ball = one_gaussian(means=[place], scales=[[0.05 * 2 / 20] * 3])
        light.append(brightness(ball, settings))
        plain.append(brightness(ball, SplatSettings(alpha_min=1e-5)))
    expected = 0.8 * 2 * math.pi * 0.05**2
    assert light == pytest.approx([expected] * 5, rel=0.01)
    # Without compensation the blur makes it 121 times brighter.
    assert plain == pytest.approx([121 * expected] * 5, rel=0.01)
