"""The Triton kernels against the float64 reference: images, radii and all gradients, small enough for the
interpreter."""

import dataclasses

import pytest
import torch

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    device_of,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

SETTINGS = {
    "default": SplatSettings(),
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.05),
    "antialias": SplatSettings(antialias=True),
    "exact": SplatSettings.preset("exact"),
    "max_sigma": SplatSettings(max_sigma=1.5),
    "box_alone": SplatSettings(alpha_min=0.0, max_sigma=2.5),
    "few_depth_bits_half_colors": SplatSettings(depth_bits=9, half_colors=True),
}
# Those of which no other test here compiles what they switch on.
ALONE = ("exclusive", "max_sigma", "box_alone", "few_depth_bits_half_colors")
DEVICE = device_of("triton")


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


LENS = vector(-0.25, 0.08, 2e-3, -1e-3, -0.01)
# Folds at r2 = 0.37: some rows are culled, and sigma points of others lie beyond.
FOLDING_LENS = vector(-0.9, 0.08, 2e-2, -1e-2, -0.01)
SHUTTER = Shutter(vector(0.1, 0.2, 0.3), vector(0.01, 0.12, 0.03))
EFFECTS = {
    "lens": {"distortion": LENS},
    "folding_lens": {"distortion": FOLDING_LENS},
    "shutter": {"shutter": SHUTTER},
    "lens_and_shutter": {"distortion": LENS, "shutter": SHUTTER},
    "from_the_bottom": {"shutter": dataclasses.replace(SHUTTER, direction="bottom")},
    "from_the_left": {"distortion": LENS, "shutter": dataclasses.replace(SHUTTER, direction="left")},
    "from_the_right": {"shutter": dataclasses.replace(SHUTTER, direction="right")},
}


def assert_matches_reference(
    gaussians: Gaussians, view: Camera, settings: SplatSettings = SETTINGS["default"], gradient_bar: float = 1e-4
) -> None:
    """The bars of the op in float32: images 1e-5, gradients 1e-4 (relative L2)."""
    truth = render(gaussians, view, "reference", torch.float64, settings)
    result = render(gaussians, view, "triton", torch.float32, settings)
    for name in ("rgb", "alpha"):
        assert (result.images[name] - truth.images[name]).abs().max() <= 1e-5, name
    # Depth is in meters and divided by alpha, so its error is relative.
    assert relative_error(result.images["depth"], truth.images["depth"]) <= 1e-5
    # Sigma points a thousand pixels away carry 1e-5.
    torch.testing.assert_close(result.radii, truth.radii, rtol=3e-5, atol=0)
    for name, gradient in truth.gradients.items():
        assert gradient.norm() > 0, f"{name}: the scene tests nothing"
        assert relative_error(result.gradients[name], gradient) <= gradient_bar, name


@pytest.mark.parametrize("name", [*first_interpreted("antialias", "default", "exact"), *ALONE])
def test_settings(name):
    view = camera(17, 19)
    assert_matches_reference(random_gaussians(9, view), view, SETTINGS[name])


@pytest.mark.parametrize("terms", first_interpreted(16, 9, 1))
def test_degrees_of_harmonics(terms):
    view = camera(7, 5)
    assert_matches_reference(random_gaussians(8, view, terms=terms, seed=1), view)


@pytest.mark.parametrize("width_height", [(1, 1), (35, 2), *first_interpreted((3, 33), (16, 16))])
def test_odd_sizes(width_height):
    view = camera(*width_height, focal=20.0)
    assert_matches_reference(random_gaussians(8, view, seed=7), view)


def test_past_the_limit_of_the_jacobian():
    # The limits lie at x/z = 0.49 and y/z = 0.38; each row is past one of them and wide enough to be seen.
    rows = [
        one_gaussian(means=[mean], scales=[[0.6, 0.5, 0.4]], quaternions=[[0.9, 0.2, -0.3, 0.1]])
        for mean in ([1.2, 0.1, 2.0], [-1.2, 0.1, 2.1], [0.1, 1.0, 2.2], [0.1, -1.0, 2.3], [1.1, 0.9, 2.4])
    ]
    assert_matches_reference(Gaussians.concatenate(rows), front_camera(9, 7, 12.0))


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("antialias", first_interpreted(False, True))
def test_effects(name, antialias):
    view = camera(17, 13)
    displacements = 0.3 * torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gaussians = dataclasses.replace(random_gaussians(9, view, terms=1), displacements=displacements)
    view = dataclasses.replace(view, **EFFECTS[name])
    assert_matches_reference(gaussians, view, SplatSettings(antialias=antialias))


def test_sigma_point_before_the_near_plane():
    # Along z the points lie at 0.6 +- 0.52 m: the nearer one is taken at 0.2 m, where its depth has no derivative.
    row = one_gaussian(means=[[0.05, 0.02, 0.6]], scales=[[0.02, 0.03, 0.3]], quaternions=[[0.99, 0.04, 0.05, 0.01]])
    assert_matches_reference(row, dataclasses.replace(front_camera(15, 13, 20.0), distortion=LENS))


def test_shutter_alone_moves_what_stands_still():
    view = camera(17, 13)
    gaussians = random_gaussians(9, view, terms=1)
    assert_matches_reference(gaussians, dataclasses.replace(view, shutter=SHUTTER))


@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_one_output_alone_from_strided_tensors(output):
    """Cotangents that are missing, and those and inputs that are not contiguous."""
    view = camera(9, 7)
    gaussians = random_gaussians(8, view)
    cotangent = dict(zip(("rgb", "alpha", "depth"), cotangents(view), strict=True))[output]
    gradients = []
    for backend, dtype in (("reference", torch.float64), ("triton", torch.float32)):
        device = device_of(backend)
        leaves = cast(gaussians, dtype, requires_grad=True, device=device)
        strided = Gaussians(*(getattr(leaves, name).repeat_interleave(2, 0)[::2] for name in FIELDS))
        image = getattr(splat(strided, view, backend=backend), output)
        image.backward(cotangent.to(device, dtype).mT.contiguous().mT)
        names = FIELDS if output == "rgb" else FIELDS[:-1]
        gradients.append(torch.cat([getattr(leaves, name).grad.double().cpu().flatten() for name in names]))
    assert relative_error(gradients[1], gradients[0]) < 1e-5


@pytest.mark.parametrize("stop", first_interpreted("inclusive", "exclusive"))
def test_pairs_behind_a_stack(stop):
    # Some 15 splats close every pixel, the loop looks after 32: 36 pairs, of which the last 4 are never looked at.
    view = front_camera(7, 6, 20.0)
    stack = [
        one_gaussian(
            means=[[0.02 * k - 0.1, 0.01 * k, 2.0 + 0.02 * k]],
            quaternions=[[0.9, 0.2, -0.3, 0.1 + 0.01 * k]],
            scales=[[1.0, 0.6, 0.8]],
            opacities=[0.6],
            sh=[[[0.01 * k] * 3]],
        )
        for k in range(36)
    ]
    scene, settings = Gaussians.concatenate(stack), SplatSettings(stop=stop)
    # Colors of neighbors differ by 0.003: what an opacity changes is a small difference of two lights.
    assert_matches_reference(scene, view, settings, gradient_bar=5e-5)
    assert render(scene, view, "triton", torch.float32, settings).images["alpha"].min() > 0.9995


def test_rounding_to_tf32_would_be_seen():
    """No kernel multiplies matrices (test_machine_code.py); if one rounded its operands to tf32, these bars would tell.

    tf32 keeps 10 of 23 bits: scales cut to it move the image by more than the bar of 1e-5.
    """
    view = camera(17, 19)
    gaussians = random_gaussians(9, view)
    cut = {name: _tf32(getattr(gaussians, name)) for name in ("scales", "quaternions")}
    truth, rounded = (render(scene, view, "reference") for scene in (gaussians, dataclasses.replace(gaussians, **cut)))
    assert (truth.images["rgb"] - rounded.images["rgb"]).abs().max() > 1e-4
    assert relative_error(rounded.gradients["scales"], truth.gradients["scales"]) > 1e-4


def _tf32(values: torch.Tensor) -> torch.Tensor:
    return (values.float().view(torch.int32) & ~0x1FFF).view(torch.float32).double()
