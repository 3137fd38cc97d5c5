"""Culling, sorting, tile lists and memory (docs/stability.md; the number in a name is the row there)."""

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, leave_one_out
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    device_of,
    every_backend,
    every_fast_precision,
    every_precision,
    fill_buffers_with_nan,
    front_camera,
    one_gaussian,
    random_gaussians,
    render,
)

Y0 = 0.28209479177387814


@every_precision
@pytest.mark.parametrize(("width", "height"), [(1, 1), (17, 9)])
def test_15_nothing_to_draw(backend, dtype, width, height):
    view = front_camera(width, height, 20.0)
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    for gaussians in (random_gaussians(0, view), one_gaussian(means=[[0.0, 0.0, -2.0]])):
        result = render(gaussians, view, backend, dtype, background=background)
        behind = background.to(dtype).double().expand_as(result.images["rgb"])
        assert torch.equal(result.images["rgb"], behind)
        assert not result.images["alpha"].any()
        assert not result.images["depth"].any()
        assert result.is_finite()
        assert all(result.gradients[name].shape == getattr(gaussians, name).shape for name in FIELDS)
        assert result.gradients["background"].all()


@pytest.mark.slow_if_interpreted
@every_fast_precision
@pytest.mark.parametrize("stop", ["inclusive", "exclusive"])
def test_16_nothing_is_read_before_it_is_written(backend, dtype, stop):
    # Many tiles stay empty, many end early.
    view, settings = camera(75, 53), SplatSettings(stop=stop)
    opaque = one_gaussian(scales=[[90.0] * 3], opacities=[1.0], means=[[0.0, 0.0, 1.0]])
    scene = Gaussians.concatenate([random_gaussians(300, view), opaque, opaque, opaque])
    expected = render(scene, view, backend, dtype, settings)
    with pytest.MonkeyPatch.context() as patch:
        fill_buffers_with_nan(patch)
        result = render(scene, view, backend, dtype, settings)
    for part in ("images", "gradients"):
        for name, value in getattr(expected, part).items():
            assert torch.equal(value, getattr(result, part)[name]), name
    assert torch.equal(expected.radii, result.radii)


@pytest.mark.lengthy
@every_fast_precision
def test_16_numbers_of_every_row_are_written(backend, dtype):
    # The third tile is empty, the stack closes the first one, and the rows at both ends are culled.
    view = front_camera(33, 5, 20.0)
    stack = [
        one_gaussian(scales=[[0.6, 0.4, 0.1]], opacities=[1.0], means=[[-0.85, 0.0, 2.0 + 0.002 * k]])
        for k in range(34)
    ]
    rows = [one_gaussian(means=[[0.0, 0.0, -2.0]]), *stack, one_gaussian(opacities=[0.0])]
    scene = cast(Gaussians.concatenate(rows), dtype, device=device_of(backend))

    drawn: list[list[torch.Tensor]] = []

    def counted() -> dict[str, torch.Tensor]:
        counters = [vars(count(scene, view, backend=backend)) for count in (contribution, leave_one_out)]
        seen = render(Gaussians.concatenate(rows), view, backend, dtype)
        drawn.append([*seen.images.values(), *seen.gradients.values()])
        return counters[0] | counters[1] | {"radii": seen.radii}

    expected = counted()
    with pytest.MonkeyPatch.context() as patch:
        fill_buffers_with_nan(patch)
        result = counted()
    assert all(map(torch.equal, *drawn))
    for name, value in expected.items():
        assert torch.equal(value, result[name]), name
        assert value[1:-1].any(), f"{name}: the scene tests nothing"
        assert not value[[0, -1]].any()


@every_precision
def test_17_depth_ties_keep_the_row_order(backend, dtype):
    view = front_camera(5, 5, 40.0)
    red, green = [[[1.0 / Y0, 0.0, 0.0]]], [[[0.0, 1.0 / Y0, 0.0]]]
    first, second = one_gaussian(sh=red), one_gaussian(sh=green)
    for front, back, channel in ((first, second, 0), (second, first, 1)):
        center = render(Gaussians.concatenate([front, back]), view, backend, dtype).images["rgb"][2, 2]
        # 0.8 (0.5 + 1) + 0.2 * 0.8 * 0.5 in the front one's channel.
        assert center[channel] == pytest.approx(1.28, rel=1e-6)


@every_precision
def test_17_neighboring_depths_are_told_apart(backend, dtype):
    far = torch.tensor(731.25, dtype=dtype)
    depths = (float(torch.nextafter(far, 2 * far)), float(far))
    parts = [
        one_gaussian(sh=[[[1.0 / Y0, 0.0, 0.0]]], means=[[0.0, 0.0, depths[0]]], scales=[[90.0] * 3]),
        one_gaussian(sh=[[[0.0, 1.0 / Y0, 0.0]]], means=[[0.0, 0.0, depths[1]]], scales=[[90.0] * 3]),
    ]
    center = render(Gaussians.concatenate(parts), front_camera(5, 5, 40.0), backend, dtype).images["rgb"][2, 2]
    assert center[1] == pytest.approx(1.28, rel=1e-5)


@pytest.mark.slow_if_interpreted
@every_backend
def test_18_two_runs_are_bitwise_equal(backend):
    view = camera(37, 29)
    gaussians = random_gaussians(80, view)
    first, second = (render(gaussians, view, backend, torch.float32) for _ in range(2))
    for part in ("images", "gradients"):
        for name, value in getattr(first, part).items():
            assert torch.equal(value, getattr(second, part)[name]), name
