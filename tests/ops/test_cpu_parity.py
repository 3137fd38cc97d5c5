"""The C++ backend against the float64 reference."""

import pytest
import torch

from sparsestreet.ops import SplatSettings, resolve_backend, splat
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.types import Gaussians
from tests.ops.scenes import FIELDS, camera, cast, cotangents, random_gaussians, relative_error, render, with_threads

SETTINGS = {
    "default": SplatSettings(),
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.05),
    "antialias": SplatSettings(antialias=True),
    "exact": SplatSettings.preset("exact"),
    "inria": SplatSettings.preset("inria"),
    "drivestudio": SplatSettings.preset("drivestudio"),
}
# Bars of the op: image 1e-5 and gradients 1e-4 in float32; in float64 only the order of sums differs.
IMAGE_BAR = {torch.float32: 1e-5, torch.float64: 1e-12}
GRADIENT_BAR = {torch.float32: 1e-4, torch.float64: 1e-10}


def assert_matches_reference(gaussians, view, dtype, settings=SETTINGS["default"], background=None):
    truth = render(gaussians, view, "reference", torch.float64, settings, background)
    result = render(gaussians, view, "cpu", dtype, settings, background)
    for name in ("rgb", "alpha"):
        assert (result.images[name] - truth.images[name]).abs().max() <= IMAGE_BAR[dtype], name
    # Depth is in meters (here up to 22) and divided by alpha, so its error is relative.
    assert relative_error(result.images["depth"], truth.images["depth"]) <= IMAGE_BAR[dtype]
    torch.testing.assert_close(result.radii, truth.radii, rtol=1e-5, atol=0)
    for name, gradient in truth.gradients.items():
        assert gradient.norm() > 0, f"{name}: the scene tests nothing"
        assert relative_error(result.gradients[name], gradient) <= GRADIENT_BAR[dtype], name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", SETTINGS)
def test_settings(name, dtype):
    view = camera(37, 53)
    assert_matches_reference(random_gaussians(250, view, terms=4), view, dtype, SETTINGS[name])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("terms", [1, 4, 9, 16])
def test_degrees_of_harmonics(terms, dtype):
    view = camera(17, 11)
    gaussians = random_gaussians(60, view, terms=terms)
    # Degree 0 has no direction; the other gradients of means exist all the same.
    assert_matches_reference(gaussians, view, dtype)


@pytest.mark.parametrize("width_height", [(1, 1), (16, 16), (17, 33), (3, 50), (64, 2)])
def test_odd_sizes(width_height):
    view = camera(*width_height, focal=20.0)
    assert_matches_reference(random_gaussians(80, view, seed=7), view, torch.float32)


@pytest.mark.parametrize("per_pixel", [False, True])
def test_background(per_pixel):
    view = camera(21, 13)
    shape = (13, 21, 3) if per_pixel else (3,)
    background = torch.rand(shape, dtype=torch.float64)
    assert_matches_reference(random_gaussians(60, view), view, torch.float32, background=background)


@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_one_output_alone(output):
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    gradients = []
    for backend in ("reference", "cpu"):
        leaves = cast(gaussians, torch.float64, requires_grad=True)
        image = getattr(splat(leaves, view, backend=backend), output)
        cotangent = dict(zip(("rgb", "alpha", "depth"), cotangents(view), strict=True))[output]
        image.backward(cotangent)
        gradients.append(
            torch.cat([getattr(leaves, name).grad.flatten() for name in FIELDS if output == "rgb" or name != "sh"])
        )
    assert relative_error(gradients[1], gradients[0]) < 1e-10


@pytest.mark.parametrize("field", FIELDS)
def test_gradcheck(field):
    view = camera(6, 5)
    gaussians = random_gaussians(12, view, terms=9, seed=3)
    values = {name: getattr(gaussians, name).clone() for name in FIELDS}
    settings = SplatSettings(alpha_min=1e-9, antialias=True)

    def images(value):
        rendering = splat(Gaussians(**(values | {field: value})), view, settings=settings, backend="cpu")
        return rendering.rgb, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(images, values[field].requires_grad_(), fast_mode=True)


@pytest.mark.lengthy
def test_bitwise_equal_for_one_and_two_threads():
    view = camera(70, 50)
    gaussians = random_gaussians(200_000, view, terms=1)
    results = with_threads((1, 2, 3), lambda: render(gaussians, view, "cpu", torch.float32))
    # With fewer visible rows one thread would do all the sorting.
    assert (results[0].radii > 0).sum() > 1 << 17
    for other in results[1:]:
        for part in ("images", "gradients"):
            for name, value in getattr(results[0], part).items():
                assert torch.equal(value, getattr(other, part)[name]), name


@pytest.mark.parametrize("variant", [0, 1, 2])
def test_every_instruction_set(variant):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    view = camera(37, 29)
    gaussians = random_gaussians(200, view)
    truth = render(gaussians, view, "reference", torch.float64)
    leaves = cast(gaussians, torch.float32, requires_grad=True)
    offsets = torch.zeros(len(gaussians), 2, requires_grad=True)
    raster = rasterizer.rasterize(leaves, offsets, view, SplatSettings(), variant)
    assert (raster.rgb.detach().double() - truth.images["rgb"]).abs().max() < 1e-5
    reference_leaves = cast(gaussians, torch.float64, requires_grad=True)
    splat(reference_leaves, view, backend="reference").rgb.backward(cotangents(view)[0])
    raster.rgb.backward(cotangents(view)[0].float())
    for name in FIELDS:
        assert relative_error(getattr(leaves, name).grad.double(), getattr(reference_leaves, name).grad) < 1e-4


def test_inputs_need_not_be_contiguous():
    view = camera(21, 13)
    gaussians = random_gaussians(60, view)
    expected = splat(gaussians, view, backend="cpu").rgb
    strided = Gaussians(*(getattr(gaussians, name).repeat_interleave(2, 0)[::2] for name in FIELDS))
    sh = gaussians.sh.transpose(0, 1).contiguous().transpose(0, 1)
    strided = Gaussians(strided.means, strided.quaternions, strided.scales, strided.opacities, sh)
    assert torch.equal(splat(strided, view, backend="cpu").rgb, expected)


def test_workspaces_of_renderings_that_live_together_do_not_mix():
    view, other_view = camera(21, 13), camera(33, 29)
    gaussians, other = random_gaussians(60, view), random_gaussians(90, other_view, seed=9)
    alone = render(gaussians, view, "cpu")
    leaves = cast(gaussians, torch.float64, requires_grad=True)
    first = splat(leaves, view, backend="cpu")
    render(other, other_view, "cpu")
    torch.autograd.backward([first.rgb, first.alpha, first.depth], list(cotangents(view)))
    for name in FIELDS:
        assert torch.equal(getattr(leaves, name).grad, alone.gradients[name])


def test_auto_takes_the_library():
    assert resolve_backend("auto", torch.device("cpu")) == "cpu"


def test_no_graph_without_grad():
    view = camera(21, 13)
    leaves = cast(random_gaussians(60, view), torch.float32, requires_grad=True)
    with torch.no_grad():
        rendering = splat(leaves, view, backend="cpu")
    assert rendering.rgb.grad_fn is None
    assert not rendering.screen_offsets.requires_grad


def test_the_library_does_not_switch_the_process_to_flush_to_zero():
    # Linking with -ffast-math would: subnormal numbers would vanish in all of torch.
    splat(random_gaussians(5, camera(5, 4)), camera(5, 4), backend="cpu")
    assert torch.tensor(1e-40) * torch.tensor(0.5) > 0
