"""Contribution counters: a hand-computed case, parity of the backends, ties, and the identity with the image."""

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, splat
from sparsestreet.types import Gaussians
from tests.ops.scenes import camera, cast, front_camera, one_gaussian, random_gaussians, with_threads

BACKENDS = ["reference", "cpu"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_balls_by_hand(backend):
    # Nine meters at 2 m: the pixel sees the peak. Weights 0.4 and 0.6 * 0.8.
    near = one_gaussian(opacities=[0.4], scales=[[9.0] * 3])
    far = one_gaussian(opacities=[0.8], scales=[[9.0] * 3], means=[[0.0, 0.0, 3.0]])
    hidden = one_gaussian(means=[[0.0, 0.0, -3.0]])
    counters = contribution(Gaussians.concatenate([far, near, hidden]), front_camera(1, 1, 40.0), backend=backend)
    assert counters.weight.tolist() == pytest.approx([0.48, 0.4, 0.0], rel=1e-9)
    assert counters.pixels.tolist() == [1, 1, 0]
    assert counters.dominant.tolist() == [1, 0, 0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_of_equal_weights_the_nearer_splat_dominates(backend):
    # 0.5 and (1 - 0.5) * 0.99 would differ; 0.25, then 0.75 / 3: weights 0.25 and 0.25 to the last bit.
    layers = [
        one_gaussian(opacities=[0.5], scales=[[900.0] * 3], means=[[0.0, 0.0, 3.0]]),
        one_gaussian(opacities=[0.25], scales=[[900.0] * 3], means=[[0.0, 0.0, 2.0]]),
        one_gaussian(opacities=[1 / 3], scales=[[900.0] * 3], means=[[0.0, 0.0, 2.5]]),
    ]
    gaussians = Gaussians.concatenate(layers)
    counters = contribution(gaussians, front_camera(1, 1, 40.0), backend=backend)
    assert counters.weight.tolist() == pytest.approx([0.25, 0.25, 0.25], rel=1e-12)
    weights = counters.weight
    first_of_largest = max((1, 2, 0), key=lambda row: (float(weights[row]), -(1, 2, 0).index(row)))
    assert counters.dominant[first_of_largest] == 1


@pytest.mark.parametrize("stop", ["inclusive", "exclusive"])
@pytest.mark.parametrize("width_height", [(1, 1), (37, 53), (64, 17)])
def test_backends_agree(width_height, stop):
    view = camera(*width_height, focal=40.0)
    gaussians = random_gaussians(300, view, seed=2)
    settings = SplatSettings(stop=stop, transmittance_min=0.02)
    truth = contribution(gaussians, view, settings=settings, backend="reference")
    counted = contribution(gaussians, view, settings=settings, backend="cpu")
    torch.testing.assert_close(counted.weight, truth.weight, rtol=1e-10, atol=1e-12)
    assert torch.equal(counted.pixels, truth.pixels)
    assert torch.equal(counted.dominant, truth.dominant)
    single = contribution(cast(gaussians, torch.float32), view, settings=settings, backend="cpu")
    # float32: alphas carry 1e-6, sums of hundreds of pixels as well.
    torch.testing.assert_close(single.weight, truth.weight, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_weights_add_up_to_the_image(backend):
    view = camera(29, 23)
    gaussians = random_gaussians(200, view)
    counters = contribution(gaussians, view, backend=backend)
    alpha = splat(gaussians, view, backend=backend).alpha
    assert float(counters.weight.sum()) == pytest.approx(float(alpha.sum()), rel=1e-10)
    assert int(counters.dominant.sum()) == int((alpha > 0).sum())


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_rows(backend):
    gaussians = random_gaussians(0, camera(5, 4))
    counters = contribution(gaussians, camera(5, 4), backend=backend)
    assert counters.weight.shape == counters.pixels.shape == counters.dominant.shape == (0,)


def test_same_for_any_number_of_threads():
    view = camera(150, 90)
    gaussians = cast(random_gaussians(3000, view), torch.float32)
    results = with_threads((1, 2), lambda: contribution(gaussians, view, backend="cpu"))
    assert torch.equal(results[0].weight, results[1].weight)
    assert torch.equal(results[0].dominant, results[1].dominant)
