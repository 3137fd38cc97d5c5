"""Pixels that break the blend (docs/stability.md; the number in a name is the row there)."""

import dataclasses
import math

import pytest
import torch

from sparsestreet.ops import Guards, SplatSettings, contribution, guards
from sparsestreet.ops.settings import StopRule
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    cast,
    cotangents,
    device_of,
    every_fast_backend,
    every_precision,
    front_camera,
    one_gaussian,
    relative_error,
    render,
)

Y0 = 0.28209479177387814


@every_precision
def test_10_one_opaque_splat_is_drawn(backend, dtype):
    opaque = one_gaussian(opacities=[1.0])
    result = render(opaque, front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["alpha"][2, 2] == pytest.approx(0.99, rel=1e-6)
    # It leaves 0.01. With a limit above that the exclusive stop drops it: that is why the default is inclusive.
    left: dict[StopRule, float] = {"inclusive": 0.99, "exclusive": 0.0}
    for stop, alpha in left.items():
        settings = SplatSettings(stop=stop, transmittance_min=0.02)
        result = render(opaque, front_camera(1, 1, 40.0), backend, dtype, settings)
        assert result.images["alpha"][0, 0] == pytest.approx(alpha, rel=1e-6)


@every_precision
def test_10_a_clamped_alpha_has_no_gradient(backend, dtype):
    # In a single pixel at the peak, alpha = 1 is clamped to 0.99: opacity and shape cannot change the image.
    opaque, view = one_gaussian(opacities=[1.0]), front_camera(1, 1, 40.0)
    result = render(opaque, view, backend, dtype)
    assert not any(result.gradients[name].any() for name in ("opacities", "scales", "quaternions", "screen"))
    assert guards(opaque, view) == Guards(drawn=1, alpha_clamped=1)
    # The clamp holds backward as well: 1 / (1 - alpha) is 100.
    torch.testing.assert_close(result.gradients["sh"][0, 0], 0.99 * Y0 * cotangents(view)[0][0, 0], rtol=1e-6, atol=0)


@every_precision
def test_11_12_opacity_at_the_cut_off(backend, dtype):
    view = front_camera(5, 5, 40.0)
    edge = torch.tensor(1 / 255, dtype=dtype)
    below = float(torch.nextafter(edge, torch.zeros_like(edge)))
    for opacity in (0.0, 1e-8, 0.0035, below):
        result = render(one_gaussian(opacities=[opacity]), view, backend, dtype)
        assert result.radii[0] == 0, opacity
        assert not result.images["alpha"].any()
        assert not any(gradient.any() for gradient in result.gradients.values())
        faint = cast(one_gaussian(opacities=[opacity]), dtype, device=device_of(backend))
        counted = contribution(faint, view, backend=backend)
        assert counted.pixels.tolist() == [0]
        assert guards(faint, view) == (Guards(faint=1) if opacity else Guards(masked=1))


@every_precision
def test_11_12_opacity_at_and_just_above_the_cut_off(backend, dtype):
    # At 1/255 itself the ellipse is the pixel center on the mean; one ulp more, and it has a size: sqrt(2 eps' 4.3) px
    # with eps' the relative step of the opacity, between eps / 2 and eps.
    view = front_camera(5, 5, 40.0)
    edge = torch.tensor(1 / 255, dtype=dtype)
    for opacity in (edge, torch.nextafter(edge, torch.ones_like(edge))):
        faint = one_gaussian(opacities=[float(opacity)])
        result = render(faint, view, backend, dtype)
        drawn = result.images["alpha"].nonzero()
        assert drawn.tolist() == [[2, 2]]
        # 1 - T is known to eps.
        assert float(result.images["alpha"][2, 2]) == pytest.approx(1 / 255, rel=255 * torch.finfo(dtype).eps)
        assert result.is_finite()
        assert result.gradients["opacities"].all()
        counted = contribution(cast(faint, dtype, device=device_of(backend)), view, backend=backend)
        assert counted.pixels.tolist() == [1]
    eps = torch.finfo(dtype).eps
    assert math.sqrt(0.9 * eps * 4.3) < float(result.radii[0]) < math.sqrt(2.1 * eps * 4.3)


@every_precision
def test_24_expected_depth_of_a_faint_splat(backend, dtype):
    result = render(one_gaussian(opacities=[0.5]), front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["alpha"][2, 2] == pytest.approx(0.5, rel=1e-6)
    assert result.images["rgb"][2, 2].tolist() == pytest.approx([0.25] * 3, rel=1e-6)
    assert result.images["depth"][2, 2] == pytest.approx(2.0, rel=1e-6)
    corner = render(one_gaussian(scales=[[1e-3] * 3]), front_camera(5, 5, 40.0), backend, dtype)
    assert corner.images["depth"][0, 0] == 0


@pytest.mark.slow_if_interpreted
@pytest.mark.parametrize("opacities", [(0.02, 0.3), (0.9, 1.0), (0.999, 1.0)], ids=["translucent", "opaque", "closed"])
@every_fast_backend
def test_26_deep_stacks(backend, opacities):
    # 400 splats in every pixel; transmittance falls to 1e-30 where nothing stops it, and would to 1e-800.
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
    # Light behind a splat as the pixel's total minus a prefix would carry 1e-7 of the total times alpha / (1 - alpha).
    for settings in (SplatSettings(), SplatSettings(transmittance_min=0.0)):
        truth = render(gaussians, view, "reference", torch.float64, settings)
        result = render(gaussians, view, backend, torch.float32, settings)
        assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-5
        for name in FIELDS:
            assert relative_error(result.gradients[name], truth.gradients[name]) < 1e-5, name


@every_fast_backend
def test_26_light_that_vanishes_in_float32(backend):
    # 0.01^40 is 0 in float32: a backward pass that begins there would find no light on its way to the front.
    layers = [
        one_gaussian(means=[[0.0, 0.0, 2 + 0.02 * k]], scales=[[90.0] * 3], opacities=[0.99], sh=[[[0.02 * k] * 3]])
        for k in range(40)
    ]
    scene, view = Gaussians.concatenate(layers), front_camera(3, 2, 20.0)
    settings = SplatSettings(transmittance_min=0.0)
    truth = render(scene, view, "reference", torch.float64, settings)
    result = render(scene, view, backend, torch.float32, settings)
    assert result.gradients["opacities"][0] != 0
    for name in ("means", "opacities", "sh"):
        # Of the opacities only the rows in front have a gradient, a small difference of large ones.
        assert relative_error(result.gradients[name], truth.gradients[name]) < 1e-4, name


@every_precision
def test_27_exponents_that_underflow(backend, dtype):
    # No cut-off: pixels 1e4 standard deviations away evaluate exp(-1e8) = 0, forward and backward.
    settings = dataclasses.replace(SplatSettings.preset("exact"), eps2d=1e-5)
    tiny = one_gaussian(scales=[[1e-12] * 3])
    result = render(tiny, front_camera(101, 1, 40.0), backend, dtype, settings)
    assert result.is_finite()
    assert result.images["alpha"][0, 0] == 0
    assert result.images["alpha"][0, 50] == pytest.approx(0.8, rel=1e-6)


@every_precision
def test_28_bright_pixels_are_not_clamped(backend, dtype):
    # A lamp of color 3: clamped at 1, it could never be fitted, as nothing would flow back.
    lamp = one_gaussian(sh=[[[2.5 / Y0] * 3]])
    result = render(lamp, front_camera(5, 5, 40.0), backend, dtype)
    assert result.images["rgb"][2, 2].tolist() == pytest.approx([0.8 * 3.0] * 3, rel=1e-6)
    assert result.gradients["sh"].all()
    assert result.gradients["opacities"].all()
