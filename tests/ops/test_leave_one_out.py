"""What taking one row away changes: held against images rendered without it, and a hand-computed case."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.ops import SplatSettings, leave_one_out, splat
from sparsestreet.types import Gaussians
from tests.ops.scenes import camera, cast, front_camera, one_gaussian, random_gaussians, with_threads

BACKENDS = ["reference", "cpu"]
NO_STOP = SplatSettings(transmittance_min=0.0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_balls_by_hand(backend):
    # Gray 0.5 over white: near 0.4, far 0.8. Without near: 0.8 * 0.5 + 0.2 = 0.6; without far: 0.2 + 0.6 = 0.8;
    # with both 0.2 + 0.24 + 0.12 = 0.56.
    near = one_gaussian(opacities=[0.4], scales=[[9.0] * 3])
    far = one_gaussian(opacities=[0.8], scales=[[9.0] * 3], means=[[0.0, 0.0, 3.0]])
    behind_camera = one_gaussian(means=[[0.0, 0.0, -3.0]])
    gaussians = Gaussians.concatenate([far, near, behind_camera])
    gray = replace(gaussians, sh=torch.zeros_like(gaussians.sh))
    changes = leave_one_out(gray, front_camera(1, 1, 40.0), background=gray.means.new_ones(3), backend=backend)
    assert changes.max_abs_change.tolist() == pytest.approx([0.24, 0.04, 0.0], rel=1e-9)
    assert changes.squared_change.tolist() == pytest.approx([3 * 0.24**2, 3 * 0.04**2, 0.0], rel=1e-9)


@pytest.mark.lengthy
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("behind", [False, True])
def test_against_images_without_the_row(backend, behind):
    view = camera(37, 21, focal=30.0)
    gaussians = random_gaussians(60, view, seed=5)
    background = torch.rand(21, 37, 3, dtype=torch.float64) if behind else None
    changes = leave_one_out(gaussians, view, background=background, settings=NO_STOP, backend=backend)
    image = splat(gaussians, view, background=background, settings=NO_STOP, backend=backend).rgb
    for row in range(len(gaussians)):
        opacities = gaussians.opacities.clone()
        opacities[row] = 0
        without = splat(
            replace(gaussians, opacities=opacities), view, background=background, settings=NO_STOP, backend=backend
        )
        change = without.rgb - image
        assert float(changes.max_abs_change[row]) == pytest.approx(float(change.abs().max()), rel=1e-9, abs=1e-12)
        assert float(changes.squared_change[row]) == pytest.approx(float(change.square().sum()), rel=1e-9, abs=1e-20)
    assert int((changes.max_abs_change > 0).sum()) > 20


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_count_as_much_as_their_weight(backend):
    view = camera(37, 21, focal=30.0)
    gaussians = random_gaussians(80, view, seed=7)
    left = torch.zeros(21, 37, dtype=torch.float64)
    left[:, :19] = 1
    plain, one, other = (
        leave_one_out(gaussians, view, pixel_weights=weights, settings=NO_STOP, backend=backend)
        for weights in (None, left, 3 * (1 - left))
    )
    torch.testing.assert_close(
        one.squared_change + other.squared_change / 3, plain.squared_change, rtol=1e-12, atol=1e-15
    )
    assert torch.equal(one.max_abs_change, plain.max_abs_change)
    # A weight alone: the change of one pixel, from an image without the row.
    row = int(one.squared_change.argmax())
    opacities = gaussians.opacities.clone()
    opacities[row] = 0
    images = [
        splat(g, view, settings=NO_STOP, backend=backend).rgb
        for g in (gaussians, replace(gaussians, opacities=opacities))
    ]
    change = (images[1] - images[0]).square().sum(-1)
    assert float(one.squared_change[row]) == pytest.approx(float(change[:, :19].sum()), rel=1e-9)


def test_weights_of_another_shape_are_refused():
    view = camera(5, 4)
    with pytest.raises(ValueError, match="pixel_weights"):
        leave_one_out(random_gaussians(3, view), view, pixel_weights=torch.ones(5, 4, dtype=torch.float64))


@pytest.mark.parametrize("stop", ["inclusive", "exclusive"])
@pytest.mark.parametrize("width_height", [(1, 1), (37, 53), (64, 17)])
def test_backends_agree(width_height, stop):
    view = camera(*width_height, focal=40.0)
    gaussians = random_gaussians(300, view, seed=2)
    settings = SplatSettings(stop=stop, transmittance_min=0.02)
    truth = leave_one_out(gaussians, view, settings=settings, backend="reference")
    counted = leave_one_out(gaussians, view, settings=settings, backend="cpu")
    torch.testing.assert_close(counted.max_abs_change, truth.max_abs_change, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(counted.squared_change, truth.squared_change, rtol=1e-9, atol=1e-14)
    single = leave_one_out(cast(gaussians, torch.float32), view, settings=settings, backend="cpu")
    # float32: the light behind carries an error of 1e-7 of the pixel, times alpha / (1 - alpha) <= 99.
    torch.testing.assert_close(single.max_abs_change, truth.max_abs_change, rtol=1e-3, atol=2e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_rows(backend):
    changes = leave_one_out(random_gaussians(0, camera(5, 4)), camera(5, 4), backend=backend)
    assert changes.max_abs_change.shape == changes.squared_change.shape == (0,)


def test_same_for_any_number_of_threads():
    view = camera(150, 90)
    gaussians = cast(random_gaussians(3000, view), torch.float32)
    results = with_threads((1, 2), lambda: leave_one_out(gaussians, view, backend="cpu"))
    assert torch.equal(results[0].max_abs_change, results[1].max_abs_change)
    assert torch.equal(results[0].squared_change, results[1].squared_change)
