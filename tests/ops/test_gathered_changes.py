"""What a backward pass gathers about leaving rows out, against the passes that look for nothing else."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import LeaveOneOutSums, SplatSettings, contribution, leave_one_out, splat
from sparsestreet.types import Camera, Gaussians, Rendering
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    cotangents,
    device_of,
    every_backend,
    every_fast_precision,
    fill_buffers_with_nan,
    random_gaussians,
    with_threads,
)

STOPS = {
    "inclusive": SplatSettings(transmittance_min=0.05),
    "exclusive": SplatSettings(transmittance_min=0.05, stop="exclusive"),
}
# float32: the light behind a splat carries an error of 1e-7 of the pixel, times alpha / (1 - alpha) <= 99; Triton takes
# it from the back in both.
CLOSE = {torch.float32: (1e-3, 2e-5), torch.float64: (1e-9, 1e-11)}


def asked(view: Camera, like: Tensor) -> LeaveOneOutSums:
    """Random weights, the third 0 in half of the image, over a random background."""
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(3, view.height, view.width, generator=generator, dtype=torch.float64)
    weights[2, :, : view.width // 2] = 0
    background = torch.rand(view.height, view.width, 3, generator=generator, dtype=torch.float64)
    return LeaveOneOutSums(weights.to(like), background.to(like))


def backward(
    given: Gaussians, view: Camera, backend: str, settings: SplatSettings, sums: LeaveOneOutSums | None
) -> tuple[Rendering, list[Tensor]]:
    rendering = splat(given, view, settings=settings, backend=backend, changes=sums)
    layers = (rendering.rgb, rendering.alpha, rendering.depth)
    torch.autograd.backward(layers, [v.to(given.means) for v in cotangents(view)])
    gradients = [getattr(given, name).grad for name in FIELDS] + [rendering.screen_offsets.grad]
    for name in FIELDS:
        getattr(given, name).grad = None
    return rendering, gradients


@every_fast_precision
@pytest.mark.parametrize(("stop", "size"), [("inclusive", (37, 53)), ("exclusive", (64, 17)), ("inclusive", (1, 1))])
def test_a_backward_pass_gathers_what_leave_one_out_and_contribution_say(size, stop, backend, dtype, monkeypatch):
    interpreted = backend == "triton"
    width, height = (17, 13) if interpreted else size
    view = camera(width, height, focal=40.0)
    settings, device = STOPS[stop], device_of(backend)
    given = cast(random_gaussians(12 if interpreted else 300, view, seed=2), dtype, requires_grad=True, device=device)
    sums = asked(view, given.means)
    fill_buffers_with_nan(monkeypatch)
    backward(given, view, backend, settings, sums)
    assert sums.found is not None
    apart = [
        leave_one_out(given, view, background=sums.background, pixel_weights=each, settings=settings, backend=backend)
        for each in sums.pixel_weights
    ]
    assert float(apart[0].squared_change.sum()) > 0.005
    rtol, atol = CLOSE[dtype]
    squared = torch.stack([one.squared_change for one in apart], 1)
    for found, expected in (
        (sums.found.max_abs_change, apart[0].max_abs_change),
        (sums.found.squared_change, squared),
        (sums.found.weight, contribution(given, view, settings=settings, backend=backend).weight),
    ):
        torch.testing.assert_close(found, expected, rtol=rtol, atol=atol)


@every_backend
def test_images_and_gradients_are_the_same_bits(backend):
    view = camera(17, 13) if backend == "triton" else camera(50, 37)
    rows = random_gaussians(12 if backend == "triton" else 200, view)
    given = cast(rows, torch.float32, requires_grad=True, device=device_of(backend))
    plain, gradients = backward(given, view, backend, STOPS["inclusive"], None)
    gathered, same = backward(given, view, backend, STOPS["inclusive"], asked(view, given.means))
    assert torch.equal(plain.rgb, gathered.rgb)
    for name, one, other in zip((*FIELDS, "screen"), gradients, same, strict=True):
        assert torch.equal(one, other), name


@every_backend
def test_no_rows_and_rows_out_of_sight(backend):
    view = camera(5, 4)
    behind = replace(random_gaussians(3, view), means=torch.tensor([[0.0, 0.0, -9.0]] * 3).double())
    for rows in (random_gaussians(0, view), behind):
        given = cast(rows, torch.float32, requires_grad=True, device=device_of(backend))
        sums = asked(view, given.means)
        backward(given, view, backend, SplatSettings(), sums)
        assert sums.found is not None
        assert {float(numbers.sum()) for numbers in vars(sums.found).values()} == {0.0}


def test_the_same_for_any_number_of_threads():
    view = camera(150, 90)
    given = cast(random_gaussians(3000, view), torch.float32, requires_grad=True)

    def found() -> dict[str, Tensor]:
        sums = asked(view, given.means)
        backward(given, view, "cpu", SplatSettings(), sums)
        return vars(sums.found)

    alone, shared = with_threads((1, 2), found)
    assert all(torch.equal(value, shared[name]) for name, value in alone.items())


def test_bad_requests_are_refused():
    view = camera(5, 4)
    given = random_gaussians(3, view)
    good = asked(view, given.means)
    for sums, said in (
        (LeaveOneOutSums(good.pixel_weights[:, 1:]), "pixel_weights must be"),
        (LeaveOneOutSums(good.pixel_weights, torch.ones(4, 5, 3)), "background must be"),
    ):
        with pytest.raises(ValueError, match=said):
            splat(given, view, changes=sums)
    with pytest.raises(ValueError, match="gates hide some of them"):
        splat(given, view, changes=good, gates=torch.ones(3).double())
