"""What rows contribute and what leaving one out changes: by hand, by images without the row, ties, and parity."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.ops import SplatSettings, contribution, leave_one_out, splat
from sparsestreet.types import Camera, Gaussians, Shutter
from tests.ops.scenes import (
    camera,
    cast,
    device_of,
    every_backend,
    every_fast_backend,
    front_camera,
    one_gaussian,
    random_gaussians,
    with_threads,
)

NO_STOP = SplatSettings(transmittance_min=0.0)
PIXEL = front_camera(1, 1, 40.0)


def of(backend: str, gaussians: Gaussians) -> Gaussians:
    """In the precision that the backend is precise in."""
    dtype = torch.float32 if backend == "triton" else torch.float64
    return cast(gaussians, dtype, device=device_of(backend))


def two_balls_and_one_behind() -> Gaussians:
    """Nine meters at 2 m: the pixel sees the peak. Gray 0.5: far 0.8, near 0.4."""
    near = one_gaussian(opacities=[0.4], scales=[[9.0] * 3])
    far = one_gaussian(opacities=[0.8], scales=[[9.0] * 3], means=[[0.0, 0.0, 3.0]])
    return Gaussians.concatenate([far, near, one_gaussian(means=[[0.0, 0.0, -3.0]])])


@every_backend
def test_two_balls_by_hand(backend):
    rows = of(backend, two_balls_and_one_behind())
    counters = contribution(rows, PIXEL, backend=backend)
    # Weights 0.4 and 0.6 * 0.8.
    assert counters.weight.tolist() == pytest.approx([0.48, 0.4, 0.0], rel=1e-6)
    assert counters.pixels.tolist() == [1, 1, 0]
    assert counters.dominant.tolist() == [1, 0, 0]
    # Over white, with both 0.2 + 0.24 + 0.12 = 0.56; without near 0.8 * 0.5 + 0.2 = 0.6; without far 0.2 + 0.6 = 0.8.
    changes = leave_one_out(rows, PIXEL, background=rows.means.new_ones(3), backend=backend)
    assert changes.max_abs_change.tolist() == pytest.approx([0.24, 0.04, 0.0], rel=1e-5)
    assert changes.squared_change.tolist() == pytest.approx([3 * 0.24**2, 3 * 0.04**2, 0.0], rel=1e-5)


@every_backend
def test_of_equal_weights_the_nearer_splat_dominates(backend):
    # 0.5 and (1 - 0.5) * 0.99 would differ; 0.25, then 0.75 / 3: weights 0.25 and 0.25 to the last bit.
    places = [(0.5, 3.0), (0.25, 2.0), (1 / 3, 2.5)]
    layers = [one_gaussian(opacities=[o], scales=[[900.0] * 3], means=[[0.0, 0.0, z]]) for o, z in places]
    counters = contribution(of(backend, Gaussians.concatenate(layers)), PIXEL, backend=backend)
    assert counters.weight.tolist() == pytest.approx([0.25, 0.25, 0.25], rel=1e-6)
    first_of_largest = max((1, 2, 0), key=lambda row: (float(counters.weight[row]), -(1, 2, 0).index(row)))
    assert counters.dominant[first_of_largest] == 1
    # Rows at one place, after one that is not drawn.
    twice = Gaussians.concatenate([one_gaussian(opacities=[0.0]), *[one_gaussian(opacities=[0.5])] * 2])
    assert contribution(of(backend, twice), PIXEL, backend=backend).dominant.tolist() == [0, 1, 0]


@every_fast_backend
@pytest.mark.parametrize(("stop", "size"), [("inclusive", (37, 53)), ("exclusive", (64, 17)), ("exclusive", (1, 1))])
def test_backends_agree(size, stop, backend):
    interpreted = backend == "triton"
    width, height = (17, 13) if interpreted else size
    view = camera(width, height, focal=40.0)
    gaussians = random_gaussians(12 if interpreted else 300, view, seed=2)
    settings = SplatSettings(stop=stop, transmittance_min=0.02)
    single, given = cast(gaussians, torch.float32, device=device_of(backend)), of(backend, gaussians)
    truth = contribution(gaussians, view, settings=settings, backend="reference")
    counted = contribution(given, view, settings=settings, backend=backend)
    assert truth.pixels.any()
    assert torch.equal(counted.pixels.cpu(), truth.pixels)
    assert torch.equal(counted.dominant.cpu(), truth.dominant)
    # float32: alphas carry 1e-6, sums of hundreds of pixels as well.
    found = contribution(single, view, settings=settings, backend=backend)
    torch.testing.assert_close(found.weight.cpu(), truth.weight, rtol=1e-4, atol=1e-5)
    lost = leave_one_out(gaussians, view, settings=settings, backend="reference")
    if not interpreted:
        torch.testing.assert_close(counted.weight, truth.weight, rtol=1e-10, atol=1e-12)
        doubles = leave_one_out(given, view, settings=settings, backend=backend)
        torch.testing.assert_close(doubles.max_abs_change, lost.max_abs_change, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(doubles.squared_change, lost.squared_change, rtol=1e-9, atol=1e-14)
    # float32: the light behind carries an error of 1e-7 of the pixel, times alpha / (1 - alpha) <= 99.
    found = leave_one_out(single, view, settings=settings, backend=backend)
    torch.testing.assert_close(found.max_abs_change.cpu(), lost.max_abs_change, rtol=1e-3, atol=2e-5)


@every_backend
@pytest.mark.parametrize("settings", [SplatSettings(), SplatSettings(max_sigma=1.5, depth_bits=12)], ids=["", "box"])
def test_weights_add_up_to_the_image(backend, settings):
    """Through a lens and a shutter."""
    shutter = Shutter(torch.tensor([0.15, -0.5, 0.3]), torch.tensor([0.02, 0.04, 0.02]))
    view = replace(camera(17, 13), distortion=torch.tensor([-0.2, 0.05, 0.0, 0.0, 0.0]), shutter=shutter)
    gaussians = of(backend, random_gaussians(12 if backend == "triton" else 200, view))
    counters = contribution(gaussians, view, settings=settings, backend=backend)
    alpha = splat(gaussians, view, settings=settings, backend=backend).alpha
    assert float(counters.weight.sum()) == pytest.approx(float(alpha.sum()), rel=1e-6)
    assert int(counters.dominant.sum()) == int((alpha > 0).sum())


def without_each(gaussians: Gaussians, view: Camera, background: Tensor | None) -> Tensor:
    """The change of the image by each row, of the reference: [rows, height, width, 3]."""

    def image(opacities: Tensor) -> Tensor:
        scene = replace(gaussians, opacities=opacities)
        return splat(scene, view, background=background, settings=NO_STOP, backend="reference").rgb

    kept = [gaussians.opacities * (torch.arange(len(gaussians)) != row) for row in range(len(gaussians))]
    return torch.stack([image(opacities) - image(gaussians.opacities) for opacities in kept])


@every_backend
@pytest.mark.parametrize("behind", [False, True], ids=["black", "background and weights"])
def test_against_images_without_the_row(backend, behind):
    """Without a stop rule a pixel is linear in each alpha."""
    view = camera(9, 7)
    gaussians, generator = random_gaussians(8, view), torch.Generator().manual_seed(1)
    background, weights = (torch.rand(7, 9, *shape, generator=generator).double() for shape in ((3,), ()))
    changes = without_each(gaussians, view, background if behind else None)
    given = of(backend, gaussians)
    found = leave_one_out(
        given,
        view,
        background=background.to(given.means) if behind else None,
        pixel_weights=weights.to(given.means) if behind else None,
        settings=NO_STOP,
        backend=backend,
    )
    squared = changes.square().sum(-1) * (weights if behind else 1)
    assert (changes.abs().amax((1, 2, 3)) > 0.01).sum() > 3
    rtol, atol = (1e-4, 1e-6) if backend == "triton" else (1e-9, 1e-12)
    torch.testing.assert_close(found.max_abs_change.cpu().double(), changes.abs().amax((1, 2, 3)), rtol=rtol, atol=atol)
    torch.testing.assert_close(found.squared_change.cpu().double(), squared.sum((1, 2)), rtol=rtol, atol=atol)


@every_backend
def test_no_rows(backend):
    rows, view = of(backend, random_gaussians(0, camera(5, 4))), camera(5, 4)
    for counters in (contribution(rows, view, backend=backend), leave_one_out(rows, view, backend=backend)):
        assert all(numbers.shape == (0,) for numbers in vars(counters).values())


def test_same_for_any_number_of_threads():
    view = camera(150, 90)
    gaussians = cast(random_gaussians(3000, view), torch.float32)
    for count in (contribution, leave_one_out):
        alone, shared = with_threads((1, 2), lambda count=count: vars(count(gaussians, view, backend="cpu")))
        assert all(torch.equal(value, shared[name]) for name, value in alone.items())
