"""C++ and Triton against the float64 reference: images, radii and all gradients, by settings and effects."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, resolve_backend, splat
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    device_of,
    every_fast_backend,
    every_fast_precision,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
    with_threads,
)

# Bars of the op: image 1e-5 and gradients 1e-4 in float32; in float64 only the order of sums differs.
IMAGE_BAR = {torch.float32: 1e-5, torch.float64: 1e-12}
GRADIENT_BAR = {torch.float32: 1e-4, torch.float64: 1e-9}
SETTINGS = {
    "default": SplatSettings(),
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.05),
    "antialias": SplatSettings(antialias=True),
    "exact": SplatSettings.preset("exact"),
    "drivestudio": SplatSettings.preset("drivestudio"),
    "box": SplatSettings(alpha_min=0.0, max_sigma=2.5),
    "bits": SplatSettings(max_sigma=1.7, depth_bits=9, half_colors=True, antialias=True, stop="exclusive"),
}


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


LENS = vector(-0.25, 0.08, 2e-3, -1e-3, -0.01)
# Folds at r2 = 0.37: some rows are culled, and sigma points of others lie beyond.
FOLDING = vector(-0.9, 0.08, 2e-2, -1e-2, -0.01)
SHUTTER = Shutter(vector(0.1, 0.2, 0.3), vector(0.01, 0.12, 0.03))
EFFECTS = {
    "plain": {},
    "lens": {"distortion": LENS},
    "folding lens": {"distortion": FOLDING},
    "top": {"shutter": SHUTTER},
    "bottom": {"shutter": replace(SHUTTER, direction="bottom")},
    "left and lens": {"distortion": LENS, "shutter": replace(SHUTTER, direction="left")},
    "right": {"shutter": replace(SHUTTER, direction="right")},
    "lens and shutter": {"distortion": LENS, "shutter": SHUTTER},
}
# Each of the settings, each of the effects, and each pair that shares a formula.
CASES = [
    *[("antialias", "plain"), ("exclusive", "plain"), ("box", "plain"), ("bits", "plain"), ("default", "folding lens")],
    *[("default", "top"), ("default", "bottom"), ("default", "left and lens"), ("default", "right")],
    *[("antialias", "lens and shutter")],
    *[
        pytest.param(*case, marks=pytest.mark.slow_if_interpreted)
        for case in [
            *[("default", "plain"), ("exact", "plain"), ("drivestudio", "plain"), ("default", "lens")],
            *[("bits", "left and lens"), ("box", "lens and shutter"), ("exact", "right")],
        ]
    ],
]


def moving_scene(backend: str, effect: str, terms: int = 4) -> tuple[Gaussians, Camera]:
    """Rows that move, few of them before the interpreter."""
    size, count = ((17, 13), 9) if backend == "triton" else ((37, 53), 250)
    view = camera(*size)
    moves = 0.3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = random_gaussians(count, view, terms=terms)
    return replace(rows, displacements=moves), replace(view, **EFFECTS[effect])


def assert_matches_reference(
    gaussians: Gaussians,
    view: Camera,
    backend: str,
    dtype: torch.dtype = torch.float32,
    settings: SplatSettings = SETTINGS["default"],
    background: Tensor | None = None,
    gradient_bar: float | None = None,
) -> None:
    truth = render(gaussians, view, "reference", torch.float64, settings, background)
    result = render(gaussians, view, backend, dtype, settings, background)
    for name in ("rgb", "alpha"):
        assert (result.images[name] - truth.images[name]).abs().max() <= IMAGE_BAR[dtype], name
    # Depth is in meters (here up to 22) and divided by alpha, so its error is relative.
    assert relative_error(result.images["depth"], truth.images["depth"]) <= IMAGE_BAR[dtype]
    # Sigma points a thousand pixels away carry 1e-5.
    assert torch.equal(result.radii > 0, truth.radii > 0)
    torch.testing.assert_close(result.radii, truth.radii, rtol=3 * IMAGE_BAR[dtype], atol=0)
    for name, gradient in truth.gradients.items():
        assert gradient.norm() > 0, f"{name}: the scene tests nothing"
        assert relative_error(result.gradients[name], gradient) <= (gradient_bar or GRADIENT_BAR[dtype]), name


@every_fast_precision
@pytest.mark.parametrize(("name", "effect"), CASES)
def test_settings_and_effects(backend, dtype, name, effect):
    assert_matches_reference(*moving_scene(backend, effect), backend, dtype, SETTINGS[name])


@every_fast_backend
@pytest.mark.parametrize("terms", first_interpreted(16, 9, 1))
def test_degrees_of_harmonics(terms, backend):
    view = camera(7, 5)
    assert_matches_reference(random_gaussians(8, view, terms=terms, seed=1), view, backend)


@every_fast_backend
@pytest.mark.parametrize("size", [(1, 1), (35, 2), *first_interpreted((3, 33), (16, 16), (64, 2))])
def test_odd_sizes(size, backend):
    view = camera(*size, focal=20.0)
    assert_matches_reference(random_gaussians(8 if backend == "triton" else 80, view, seed=7), view, backend)


@every_fast_backend
@pytest.mark.parametrize("shape", [(3,), (7, 9, 3)])
def test_background(shape, backend):
    view, background = camera(9, 7), torch.rand(shape, dtype=torch.float64)
    assert_matches_reference(random_gaussians(9, view), view, backend, background=background)


@every_fast_backend
def test_past_the_limit_of_the_jacobian(backend):
    # The limits lie at x/z = 0.49 and y/z = 0.38; each row is past one of them and wide enough to be seen.
    rows = [
        one_gaussian(means=[mean], scales=[[0.6, 0.5, 0.4]], quaternions=[[0.9, 0.2, -0.3, 0.1]])
        for mean in ([1.2, 0.1, 2.0], [-1.2, 0.1, 2.1], [0.1, 1.0, 2.2], [0.1, -1.0, 2.3], [1.1, 0.9, 2.4])
    ]
    assert_matches_reference(Gaussians.concatenate(rows), front_camera(9, 7, 12.0), backend)


@every_fast_backend
def test_sigma_point_before_the_near_plane(backend):
    # Along z the points lie at 0.6 +- 0.52 m: the nearer one is taken at 0.2 m, where its depth has no derivative.
    row = one_gaussian(means=[[0.05, 0.02, 0.6]], scales=[[0.02, 0.03, 0.3]], quaternions=[[0.99, 0.04, 0.05, 0.01]])
    assert_matches_reference(row, replace(front_camera(15, 13, 20.0), distortion=LENS), backend)


@every_fast_backend
def test_shutter_alone_moves_what_stands_still(backend):
    view = camera(17, 13)
    assert_matches_reference(random_gaussians(9, view, terms=1), replace(view, shutter=SHUTTER), backend)


@every_fast_backend
@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_one_output_alone_from_strided_tensors(output, backend):
    """Cotangents that are missing, and those and inputs that are not contiguous."""
    view = camera(9, 7)
    gaussians = random_gaussians(8, view)
    cotangent = dict(zip(("rgb", "alpha", "depth"), cotangents(view), strict=True))[output]
    gradients = []
    for name, dtype in (("reference", torch.float64), (backend, torch.float32)):
        leaves = cast(gaussians, dtype, requires_grad=True, device=device_of(name))
        strided = Gaussians(*(getattr(leaves, field).repeat_interleave(2, 0)[::2] for field in FIELDS))
        image = getattr(splat(strided, view, backend=name), output)
        image.backward(cotangent.to(image).mT.contiguous().mT)
        used = FIELDS if output == "rgb" else FIELDS[:-1]
        gradients.append(torch.cat([getattr(leaves, field).grad.double().cpu().flatten() for field in used]))
    assert relative_error(gradients[1], gradients[0]) < 1e-5


@every_fast_backend
@pytest.mark.parametrize("stop", first_interpreted("inclusive", "exclusive"))
def test_pairs_behind_a_stack(stop, backend):
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
    assert_matches_reference(scene, view, backend, settings=settings, gradient_bar=5e-5)
    assert render(scene, view, backend, torch.float32, settings).images["alpha"].min() > 0.9995


@pytest.mark.parametrize("variant", [0, 1, 2])
@pytest.mark.parametrize(("name", "effect"), [("default", "plain"), ("bits", "left and lens")])
def test_every_instruction_set(variant, name, effect):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    gaussians, view = moving_scene("cpu", effect, terms=16)
    truth = cast(gaussians, torch.float64, requires_grad=True)
    splat(truth, view, settings=SETTINGS[name], backend="reference").rgb.backward(cotangents(view)[0])
    for dtype, bar in GRADIENT_BAR.items():
        leaves = cast(gaussians, dtype, requires_grad=True)
        offsets = torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True)
        raster = rasterizer.rasterize(leaves, offsets, view, SETTINGS[name], variant)
        raster.rgb.backward(cotangents(view)[0].to(dtype))
        for field in FIELDS:
            assert relative_error(getattr(leaves, field).grad.double(), getattr(truth, field).grad) < bar, field


@pytest.mark.parametrize("rows", [0, 1, 3, 17, 33])
@pytest.mark.parametrize("effect", ["top", "left and lens"])
def test_registers_need_not_be_full(rows, effect):
    gaussians, view = moving_scene("cpu", effect, terms=16)
    few = Gaussians(*(value[:rows] for value in vars(gaussians).values()))
    hidden = replace(gaussians, opacities=torch.where(torch.arange(250) < rows, gaussians.opacities, 0.0))
    alone, among = (render(scene, view, "cpu", torch.float32) for scene in (few, hidden))
    for name, image in alone.images.items():
        assert torch.equal(image, among.images[name]), name
    for name, gradient in alone.gradients.items():
        assert torch.equal(gradient, among.gradients[name][:rows]), name
        assert not among.gradients[name][rows:].any(), name


@pytest.mark.slow
def test_threads_change_no_bit_of_a_large_sort():
    view = camera(70, 50)
    gaussians = random_gaussians(200_000, view, terms=1)
    results = with_threads((1, 3), lambda: render(gaussians, view, "cpu", torch.float32))
    # With fewer visible rows one thread would do all the sorting.
    assert (results[0].radii > 0).sum() > 1 << 17
    assert_same_bits(*results)


def test_threads_change_no_bit():
    gaussians, view = moving_scene("cpu", "lens and shutter")
    many = Gaussians(*(value.repeat(12, *[1] * (value.ndim - 1)) for value in vars(gaussians).values()))
    results = with_threads((1, 2, 3), lambda: render(many, view, "cpu", torch.float32, SETTINGS["bits"]))
    for other in results[1:]:
        assert_same_bits(results[0], other)


def assert_same_bits(result, other) -> None:
    for part in ("images", "gradients"):
        for name, value in getattr(result, part).items():
            assert torch.equal(value, getattr(other, part)[name]), name


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


def test_auto_takes_the_library_and_keeps_no_graph_without_grad():
    assert resolve_backend("auto", torch.device("cpu")) == "cpu"
    view = camera(21, 13)
    leaves = cast(random_gaussians(60, view), torch.float32, requires_grad=True)
    with torch.no_grad():
        rendering = splat(leaves, view, backend="cpu")
    assert rendering.rgb.grad_fn is None
    assert not rendering.screen_offsets.requires_grad
    # Linking with -ffast-math would let subnormal numbers vanish in all of torch.
    assert torch.tensor(1e-40) * torch.tensor(0.5) > 0
