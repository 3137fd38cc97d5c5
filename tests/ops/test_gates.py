"""Gates: a factor of each row's alpha in the pixel loop, whose gradient exists where it hides the row."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, splat
from sparsestreet.ops.cpu import rasterizer
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    device_of,
    every_backend,
    every_fast_kind,
    every_precision,
    fill_buffers_with_nan,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    with_threads,
)
from tests.typed import there

BACKENDS = ["reference", "cpu"]
"""For scenes that take Triton's interpreter long; triton/test_gates.py has smaller ones."""
STOPS = {
    "inclusive": SplatSettings(transmittance_min=0.05),
    "exclusive": SplatSettings(transmittance_min=0.05, stop="exclusive"),
    "exact": SplatSettings.preset("exact"),
    "antialias": SplatSettings(antialias=True),
    "loose": SplatSettings(alpha_min=1e-9),
}
# Bars of the op, as in test_parity.py.
IMAGE_BAR = {torch.float32: 1e-5, torch.float64: 1e-12}
GRADIENT_BAR = {torch.float32: 1e-4, torch.float64: 1e-10}
BY_HAND = {torch.float32: 1e-6, torch.float64: 1e-12}
WHITE, GRAY = [[[0.5 / 0.28209479177387814] * 3]], [[[0.0] * 3]]


def layers(*opacities: float, colors: tuple[list, ...]) -> Gaussians:
    """Splats behind each other that fill a lone pixel evenly: 2 m away, 3 m, and so on."""
    parts = [
        one_gaussian(opacities=[opacity], means=[[0.0, 0.0, 2.0 + k]], scales=[[9.0] * 3], sh=color)
        for k, (opacity, color) in enumerate(zip(opacities, colors, strict=True))
    ]
    return Gaussians.concatenate(parts)


def drawn(rows: int, seed: int = 2, fractions: bool = False) -> Tensor:
    """Zeros and ones, half of each; or any factors between, which no sampling gives but the formula has."""
    uniform = torch.rand(rows, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return uniform.float().double() if fractions else (uniform > 0.5).double()


def gated(
    gaussians: Gaussians,
    view: Camera,
    gates: Tensor | None,
    backend: str,
    dtype: torch.dtype = torch.float64,
    settings: SplatSettings = STOPS["exact"],
    background: Tensor | None = None,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Images and gradients of random cotangents, in float64 on the CPU."""
    device = device_of(backend)
    leaves = cast(gaussians, dtype, requires_grad=True, device=device)
    factors = None if gates is None else gates.detach().clone().to(device, dtype).requires_grad_()
    behind = None if background is None else background.detach().clone().to(device, dtype).requires_grad_()
    rendering = splat(leaves, view, background=behind, settings=settings, backend=backend, gates=factors)
    images = {"rgb": rendering.rgb, "alpha": rendering.alpha, "depth": rendering.depth}
    torch.autograd.backward(list(images.values()), [v.to(device, dtype) for v in cotangents(view)])
    gradients = {name: there(getattr(leaves, name).grad) for name in FIELDS}
    gradients["screen"] = there(rendering.screen_offsets.grad)
    if factors is not None:
        gradients["gates"] = there(factors.grad)
    if behind is not None:
        gradients["background"] = there(behind.grad)
    images["radii"] = rendering.radii
    return _doubles(images), _doubles(gradients)


def _doubles(values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().double().cpu() for name, value in values.items()}


@every_precision
def test_two_layers_by_hand(backend, dtype):
    """White of 0.8 before gray of 0.5 over black: dC/dM_1 = 0.8 (1 - 0.5 M_2 0.5), dC/dM_2 = 0.5 T_2 0.5."""
    bar, device = BY_HAND[dtype], device_of(backend)
    pair = cast(layers(0.8, 0.5, colors=(WHITE, GRAY)), dtype, device=device)
    for first, second in ((0.0, 1.0), (1.0, 0.0), (0.0, 0.0), (1.0, 1.0)):
        gates = torch.tensor([first, second], dtype=dtype, device=device, requires_grad=True)
        rendering = splat(pair, front_camera(1, 1, 40.0), backend=backend, gates=gates)
        passed = 1 - 0.8 * first
        assert rendering.rgb.flatten().tolist() == pytest.approx([0.8 * first + 0.25 * second * passed] * 3, rel=bar)
        assert rendering.alpha.item() == pytest.approx(1 - passed * (1 - 0.5 * second), abs=bar)
        (gradient,) = torch.autograd.grad(rendering.rgb[0, 0, 0], gates)
        # c - b: white less what is seen behind it, gray less black.
        expected = [0.8 * (1 - 0.5 * second * 0.5), 0.5 * passed * 0.5]
        assert gradient.tolist() == pytest.approx(expected, rel=bar)


@every_precision
def test_a_clamped_alpha_gives_its_gate_a_gradient(backend, dtype):
    """The gate multiplies what the clamp leaves, 0.99; alpha itself has no derivative there."""
    leaves = cast(layers(1.0, colors=(WHITE,)), dtype, requires_grad=True, device=device_of(backend))
    gates = torch.ones(1, dtype=dtype, device=device_of(backend), requires_grad=True)
    rendering = splat(leaves, front_camera(1, 1, 40.0), backend=backend, gates=gates)
    rendering.rgb[0, 0, 0].backward()
    assert gates.grad.item() == pytest.approx(0.99, rel=BY_HAND[dtype])
    assert leaves.opacities.grad.item() == 0


@every_precision
@pytest.mark.parametrize("stop", first_interpreted("exclusive", "inclusive"))
def test_the_stop_rule_sees_gated_alphas(backend, dtype, stop):
    """Of alphas 0.9 two leave 0.01, which is below 0.05: with the first gate 0, the third is the second that counts.

    Where a gate of 0 comes before the pixel is finished it has a gradient, behind that it has none."""
    device, bar = device_of(backend), BY_HAND[dtype]
    stack = cast(layers(*[0.9] * 4, colors=(WHITE,) * 4), dtype, device=device)
    settings = SplatSettings(transmittance_min=0.05, stop=stop)
    view = front_camera(1, 1, 40.0)

    def of(*values: float) -> tuple[float, list[float]]:
        gates = torch.tensor(values, dtype=dtype, device=device, requires_grad=True)
        alpha = splat(stack, view, settings=settings, backend=backend, gates=gates).alpha
        (gradient,) = torch.autograd.grad(alpha.sum(), gates)
        return alpha.item(), gradient.tolist()

    both, one = 0.99, 0.9
    assert of(1, 1, 1, 1)[0] == pytest.approx(both if stop == "inclusive" else one, rel=bar)
    alpha, gradient = of(0, 1, 1, 0)
    if stop == "inclusive":
        assert alpha == pytest.approx(both, rel=bar)
        assert gradient == pytest.approx([0.9 * 0.01, 0.09, 0.09, 0], abs=bar)
    else:
        assert alpha == pytest.approx(one, rel=bar)
        assert gradient == pytest.approx([0.09, 0.9, 0, 0], abs=bar)
    # The last splat before the pixel is finished, hidden: 0.1 of the light reaches it.
    alpha, gradient = of(1, 0, 0, 0)
    assert alpha == pytest.approx(one, rel=bar)
    assert gradient == pytest.approx([0.9, 0.09, 0.09, 0.09], rel=bar)


@every_precision
def test_all_gates_closed_show_the_background_and_still_learn(backend, dtype):
    view, background = camera(9, 7), torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64)
    gaussians = random_gaussians(9, view)
    images, gradients = gated(gaussians, view, torch.zeros(9), backend, dtype, background=background)
    assert torch.equal(images["rgb"], background.to(dtype).double().expand(7, 9, 3))
    assert not images["alpha"].any()
    assert all(not gradients[name].any() for name in (*FIELDS, "screen"))
    seen = images["radii"] > 0
    assert seen.any()
    assert torch.equal(gradients["gates"] != 0, seen)


@every_precision
def test_open_gates_change_nothing_but_rounding(backend, dtype):
    view = camera(17, 13)
    gaussians = random_gaussians(20, view)
    plain, opened = (gated(gaussians, view, gates, backend, dtype) for gates in (None, torch.ones(20)))
    for without, given in zip(plain, opened, strict=True):
        for name, value in without.items():
            # alpha 1 is alpha, but the compiler may contract the product of the gate with another sum.
            torch.testing.assert_close(given[name], value, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=1e-6)
    assert torch.equal(plain[0]["radii"], opened[0]["radii"])


@pytest.mark.parametrize("backend", BACKENDS)
def test_closed_rows_show_as_if_they_were_gone(backend):
    view, closed = camera(21, 13), drawn(60) == 0
    gaussians = random_gaussians(60, view)
    images, gradients = gated(gaussians, view, drawn(60), backend)
    left = Gaussians(*(getattr(gaussians, name)[~closed] for name in FIELDS))
    expected, of_left = gated(left, view, None, backend)
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(images[name], expected[name], rtol=1e-12, atol=1e-12)
    for name in FIELDS:
        torch.testing.assert_close(gradients[name][~closed], of_left[name], rtol=1e-10, atol=1e-12)
        assert not gradients[name][closed].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("field", "name"),
    [*[("gates", name) for name in ("inclusive", "exclusive", "exact")], *[(field, "loose") for field in FIELDS]],
)
def test_gradcheck(backend, field, name):
    view = camera(6, 5)
    gaussians = random_gaussians(12, view, seed=3)
    # Not at 0 and 1 themselves, from where a difference would leave [0, 1].
    values = vars(gaussians) | {"gates": 0.02 + 0.96 * drawn(12, fractions=True)}

    def images(value: Tensor) -> tuple[Tensor, ...]:
        fields = values | {field: value}
        gates, settings = fields.pop("gates"), STOPS[name]
        rendering = splat(Gaussians(**fields), view, settings=settings, backend=backend, gates=gates)
        return rendering.rgb, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(images, values[field].clone().requires_grad_(), fast_mode=True)


@every_fast_kind
@pytest.mark.parametrize(
    ("size", "name", "fractions"),
    [
        ((9, 7), "antialias", False),
        *[
            pytest.param(size, name, fractions, marks=pytest.mark.slow_if_interpreted)
            for size, name, fractions in [
                *[((37, 53), "inclusive", True), ((37, 53), "exclusive", False), ((17, 33), "exclusive", True)],
                *[((17, 33), "inclusive", False), ((1, 1), "antialias", False), ((35, 2), "inclusive", False)],
            ]
        ],
    ],
)
def test_backends_match_the_reference(backend, dtype, size, name, fractions, monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    view, rows = camera(*size, focal=37.0), 12 if backend == "triton" else 250
    gaussians, gates = random_gaussians(rows, view, seed=7), drawn(rows, fractions=fractions)
    truth, of_truth = gated(gaussians, view, gates, "reference", settings=STOPS[name])
    images, gradients = gated(gaussians, view, gates, backend, dtype, STOPS[name])
    for image in ("rgb", "alpha"):
        assert (images[image] - truth[image]).abs().max() <= IMAGE_BAR[dtype], image
    assert relative_error(images["depth"], truth["depth"]) <= IMAGE_BAR[dtype]
    for field, gradient in of_truth.items():
        assert gradient.norm() > 0, f"{field}: the scene tests nothing"
        assert relative_error(gradients[field], gradient) <= GRADIENT_BAR[dtype], field
    hidden = (gates == 0) & (truth["radii"] > 0)
    if hidden.any():
        assert relative_error(gradients["gates"][hidden], of_truth["gates"][hidden]) <= GRADIENT_BAR[dtype]


@pytest.mark.parametrize("variant", [0, 1, 2])
def test_every_instruction_set(variant):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    view, gates = camera(37, 29), drawn(200)
    gaussians = random_gaussians(200, view)
    leaves, factors = cast(gaussians, torch.float32, requires_grad=True), gates.float().requires_grad_()
    raster = rasterizer.rasterize(leaves, torch.zeros(200, 2), view, SplatSettings(), variant, gates=factors)
    expected = gates.clone().requires_grad_()
    splat(gaussians, view, backend="reference", gates=expected).rgb.backward(cotangents(view)[0])
    raster.rgb.backward(cotangents(view)[0].float())
    truth = there(expected.grad)
    assert truth.any()
    assert relative_error(there(factors.grad).double(), truth) < 1e-4


def test_threads_change_no_bit():
    view, gaussians = camera(70, 50), random_gaussians(400, camera(70, 50))
    results = with_threads((1, 2, 3), lambda: gated(gaussians, view, drawn(400), "cpu", torch.float32))
    for other in results[1:]:
        for first, again in zip(results[0], other, strict=True):
            assert all(torch.equal(value, again[name]) for name, value in first.items())


@every_precision
def test_no_rows(backend, dtype):
    view, device = camera(5, 4), device_of(backend)
    leaves = cast(random_gaussians(0, view), dtype, requires_grad=True, device=device)
    gates = torch.zeros(0, dtype=dtype, device=device, requires_grad=True)
    rendering = splat(leaves, view, backend=backend, gates=gates)
    rendering.alpha.sum().backward()
    assert not rendering.alpha.any()
    assert gates.grad.shape == (0,)


@every_backend
def test_gates_that_are_none(backend):
    view = camera(9, 7)
    # In one precision on the CPU, where values are read.
    gaussians = cast(random_gaussians(5, view), torch.float32)
    for bad, message in (
        (torch.ones(4), r"gates must be \[5\] torch.float32 on cpu like the means, got \[4\]"),
        (torch.ones(5).double(), "got .*float64 on cpu: give one factor per Gaussian"),
        (torch.tensor([1, 1, 1.5, 1, 1]), r"gates must lie in \[0, 1\], but row 2 has 1.5"),
        (torch.tensor([1, 1, 1, torch.nan, 1]), r"gates must lie in \[0, 1\], but row 3 has nan"),
    ):
        with pytest.raises(ValueError, match=message):
            splat(gaussians, view, backend=backend, gates=bad)
