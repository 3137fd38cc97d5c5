"""The reference against hand-computed values, a naive NumPy renderer, scipy's harmonics and finite differences."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.spherical_harmonics import basis
from sparsestreet.types import Camera, Gaussians
from tests.ops.oracles import naive_image
from tests.ops.scenes import FIELDS, camera, cast, front_camera, one_gaussian, random_gaussians, render

LOOSE = SplatSettings(alpha_min=1e-9)


def test_one_ball_by_hand():
    # 0.1 m at 2 m with focal 40: sigma = 2 px, variance 4 + 0.3 blur. A 5x5 image: the center pixel is (2.5, 2.5).
    rendering = splat(one_gaussian(), front_camera(5, 5, 40.0), backend="reference")
    for (row, column), squared in {(2, 2): 0.0, (2, 3): 1.0, (1, 3): 2.0, (0, 4): 8.0}.items():
        alpha = 0.8 * math.exp(-0.5 * squared / 4.3)
        assert rendering.alpha[row, column].item() == pytest.approx(alpha, rel=1e-12)
        assert rendering.rgb[row, column].tolist() == pytest.approx([0.5 * alpha] * 3, rel=1e-12)
        assert rendering.depth[row, column].item() == pytest.approx(2.0, rel=1e-12)
    # The box ends where 0.8 exp(-q/2) = 1/255.
    assert rendering.radii.item() == pytest.approx(math.sqrt(2 * math.log(0.8 * 255) * 4.3), rel=1e-12)
    assert rendering.visible.all()


def test_two_layers_over_a_background_by_hand():
    white, black = [[[0.5 / 0.28209479177387814] * 3]], [[[-0.5 / 0.28209479177387814] * 3]]
    near, far = one_gaussian(sh=white), one_gaussian(sh=black, means=[[0.0, 0.0, 4.0]], opacities=[0.5])
    rendering = splat(
        Gaussians.concatenate([far, near]),
        front_camera(5, 5, 40.0),
        background=torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64),
        backend="reference",
    )
    passed = (1 - 0.8) * (1 - 0.5)
    assert rendering.rgb[2, 2].tolist() == pytest.approx([0.8 + passed, 0.8 + 0.5 * passed, 0.8], rel=1e-12)
    assert rendering.depth[2, 2].item() == pytest.approx((0.8 * 2 + 0.2 * 0.5 * 4) / (1 - passed), rel=1e-12)


def test_against_a_naive_renderer():
    view = camera(13, 9)
    gaussians = random_gaussians(40, view, terms=1)
    image = splat(gaussians, view, backend="reference").rgb.numpy()
    # float64 on both sides, different order of operations.
    np.testing.assert_allclose(image, naive_image(gaussians, view, SplatSettings()), atol=1e-12)


def test_harmonics_against_scipy():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    x, y, z = directions.numpy().T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            if order < 0:
                columns.append(math.sqrt(2) * value.imag)
            else:
                columns.append(value.real * (math.sqrt(2) if order else 1.0))
    np.testing.assert_allclose(basis(directions, 16).numpy(), np.stack(columns, -1), atol=1e-12)


@pytest.mark.parametrize(
    "settings",
    [LOOSE, SplatSettings(alpha_min=1e-9, stop="exclusive", antialias=True)],
    ids=["default", "exclusive_antialias"],
)
@pytest.mark.parametrize("field", FIELDS)
def test_gradient_of_each_field(field, settings):
    view = camera(5, 4)
    gaussians = random_gaussians(8, view, terms=16, seed=3)
    values = {name: getattr(gaussians, name).clone() for name in FIELDS}

    def images(value):
        rendering = splat(Gaussians(**(values | {field: value})), view, settings=settings, backend="reference")
        return rendering.rgb, rendering.alpha, rendering.depth

    # Random projections of both Jacobians: a full one would take minutes.
    assert torch.autograd.gradcheck(images, values[field].requires_grad_(), fast_mode=True)


@pytest.mark.lengthy
def test_screen_offsets_gather_absolute_gradients():
    # Independent: differentiate each pixel on its own with respect to the mean, and add up absolute values.
    view = front_camera(4, 3, 6.0)
    gaussians = one_gaussian(means=[[0.1, -0.05, 2.0]], scales=[[0.4, 0.2, 0.3]])
    cotangent = torch.randn(3, 4, 3, dtype=torch.float64)
    expected = torch.zeros(2, dtype=torch.float64)
    for row, column in np.ndindex(3, 4):
        # Moving the principal point moves the mean on the screen, and the Jacobian's limits, which do not act here.
        pixels = []
        for axis in range(2):
            values = []
            for step in (1e-6, -1e-6):
                moved = view.intrinsics.clone()
                moved[axis, 2] += step
                shifted = Camera(view.camera_from_world, moved, view.width, view.height)
                image = splat(gaussians, shifted, backend="reference", settings=LOOSE).rgb
                values.append(float((image[row, column] * cotangent[row, column]).sum()))
            pixels.append((values[0] - values[1]) / 2e-6)
        expected += torch.tensor(pixels, dtype=torch.float64).abs()
    leaves = cast(gaussians, torch.float64, requires_grad=True)
    rendering = splat(leaves, view, backend="reference", settings=LOOSE)
    rendering.rgb.backward(cotangent)
    # Central differences of step 1e-6: about 1e-9.
    torch.testing.assert_close(rendering.screen_offsets.grad[0], expected, rtol=1e-7, atol=1e-8)


def test_image_does_not_depend_on_the_chunks_of_pixels(monkeypatch):
    view = camera(13, 9)
    gaussians = random_gaussians(40, view)
    whole = render(gaussians, view, "reference")
    monkeypatch.setattr("sparsestreet.ops.reference.blend._CHUNK_ELEMENTS", 700)
    pieces = render(gaussians, view, "reference")
    for name, gradient in whole.gradients.items():
        torch.testing.assert_close(pieces.gradients[name], gradient, rtol=1e-10, atol=1e-12)
