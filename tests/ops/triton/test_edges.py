"""What breaks renderers at the edges, on the Triton kernels: lists, memory, order."""

import dataclasses

import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution, splat
from sparsestreet.ops.triton import lists, rasterizer
from sparsestreet.types import Gaussians, Shutter
from tests.ops.scenes import (
    FIELDS,
    camera,
    cast,
    device_of,
    first_interpreted,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

DEVICE = device_of("triton")
VIEW = camera(9, 7)


def single(gaussians: Gaussians) -> Gaussians:
    return cast(gaussians, torch.float32, device=DEVICE)


def assert_same_bits(result, other) -> None:
    for part in ("images", "gradients"):
        for name, value in getattr(result, part).items():
            assert torch.equal(value, getattr(other, part)[name]), name


@pytest.mark.slow_if_interpreted
def test_two_runs_are_bitwise_equal():
    view = camera(19, 17)
    gaussians = random_gaussians(12, view)
    first = render(gaussians, view, "triton", torch.float32)
    # The interpreter has one order; on a device programs run in another one each time.
    for _ in range(1 if DEVICE.type == "cpu" else 19):
        assert_same_bits(first, render(gaussians, view, "triton", torch.float32))


def test_the_order_of_rows_does_not_matter_without_ties():
    view = camera(19, 17)
    gaussians = random_gaussians(12, view)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = Gaussians(*(getattr(gaussians, name)[order] for name in FIELDS))
    plain, other = (render(scene, view, "triton", torch.float32) for scene in (gaussians, shuffled))
    assert torch.equal(plain.images["rgb"], other.images["rgb"])
    for name in FIELDS:
        assert torch.equal(plain.gradients[name][order], other.gradients[name]), name


def test_masked_rows_leave_no_trace():
    view = camera(13, 9)
    gaussians = random_gaussians(12, view)
    keep = torch.arange(12) % 3 > 0
    without = Gaussians(*(getattr(gaussians, name)[keep] for name in FIELDS))
    masked = dataclasses.replace(gaussians, opacities=gaussians.opacities * keep)
    # Nothing but their opacity is read.
    masked.means[~keep] = float("nan")
    plain, dropped = (render(scene, view, "triton", torch.float32) for scene in (without, masked))
    for name, image in plain.images.items():
        assert torch.equal(image, dropped.images[name])
    for name in FIELDS:
        assert torch.equal(plain.gradients[name], dropped.gradients[name][keep])
        assert not dropped.gradients[name][~keep].any()


@pytest.mark.lengthy
@pytest.mark.parametrize("effects", first_interpreted(False, True))
def test_nothing_is_read_before_it_is_written(effects, monkeypatch):
    # The third tile is empty; the stack closes the first one, so that its pairs behind the 32nd are never looked at.
    view = front_camera(33, 5, 20.0)
    if effects:
        slow = Shutter(torch.full((3,), 0.01), torch.full((3,), 0.01))
        view = dataclasses.replace(view, distortion=torch.full((5,), 0.001), shutter=slow)
    stack = [
        one_gaussian(scales=[[0.6, 0.4, 0.1]], opacities=[1.0], means=[[-0.85, 0.0, 2.0 + 0.002 * k]])
        for k in range(34)
    ]
    scene = Gaussians.concatenate([one_gaussian(means=[[0.0, 0.0, -2.0]]), *stack, one_gaussian(opacities=[0.0])])
    expected = render(scene, view, "triton", torch.float32)
    counted = contribution(single(scene), view, backend="triton")

    def poisoned(like):
        def filled(*args, **kwargs):
            tensor = like(*args, **kwargs)
            return tensor.fill_(float("nan") if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max)

        return filled

    monkeypatch.setattr(torch.Tensor, "new_empty", poisoned(torch.Tensor.new_empty))
    monkeypatch.setattr(torch, "empty_like", poisoned(torch.empty_like))
    assert_same_bits(render(scene, view, "triton", torch.float32), expected)
    again = contribution(single(scene), view, backend="triton")
    assert torch.equal(again.weight, counted.weight)
    assert torch.equal(again.dominant, counted.dominant)


def test_an_overflowing_row_is_culled():
    # 1e25 m is finite, its variance on the screen is not.
    good = random_gaussians(4, VIEW)
    both = Gaussians.concatenate([good, one_gaussian(scales=[[1e25] * 3], sh=[[[0.0] * 3] * 4])])
    alone, together = (render(scene, VIEW, "triton", torch.float32) for scene in (good, both))
    assert torch.equal(alone.images["rgb"], together.images["rgb"])
    assert together.is_finite()
    assert together.radii[-1] == 0


def test_no_motion_is_no_shutter():
    """The same bits, but for gradients on a device: of two kernels the compiler contracts not the same products."""
    gaussians = random_gaussians(6, VIEW)
    still = dataclasses.replace(VIEW, shutter=Shutter(torch.zeros(3), torch.zeros(3)))
    plain, rolled = (render(gaussians, view, "triton", torch.float32) for view in (VIEW, still))
    for name, image in plain.images.items():
        assert torch.equal(image, rolled.images[name]), name
    for name, gradient in plain.gradients.items():
        bar = 0.0 if DEVICE.type == "cpu" else 1e-6
        assert relative_error(rolled.gradients[name], gradient) <= bar, name


def test_behind_the_fold_of_the_lens():
    # 1 + 3 k1 r2 vanishes at r2 = 1 / 3: the first row lies at 0.3, the second at 0.36.
    view = dataclasses.replace(front_camera(41, 9, 15.0), distortion=torch.tensor([-1.0, 0.0, 0.0, 0.0, 0.0]))
    rows = [one_gaussian(means=[[2 * r2**0.5, 0.0, 2.0]]) for r2 in (0.3, 0.36)]
    result = render(Gaussians.concatenate(rows), view, "triton", torch.float32)
    assert (result.radii > 0).tolist() == [True, False]
    assert result.is_finite()
    assert not result.gradients["means"][1].any()


@pytest.mark.parametrize("settings", [SplatSettings(), SplatSettings(antialias=True, stop="exclusive", eps2d=0.0)])
def test_no_nan_in_extreme_scenes(settings):
    generator = torch.Generator().manual_seed(3)

    def spread(*shape: int, low: float, high: float) -> torch.Tensor:
        return 10 ** (low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64))

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    depth = torch.cat((0.2 + spread(15, 1, low=-7, high=-3), spread(25, 1, low=-2, high=4)))
    parts = (
        torch.cat((normal(40, 2) * depth, depth), -1),
        normal(40, 4) * spread(40, 1, low=-22, high=8),
        spread(40, 3, low=-12, high=6) * (torch.rand(40, 3, generator=generator) > 0.1),
        torch.rand(40, generator=generator, dtype=torch.float64).round(decimals=1),
        normal(40, 4, 3) * spread(40, 1, 1, low=-3, high=3),
    )
    gaussians = Gaussians(*(part.float().double() for part in parts))
    result = render(gaussians, front_camera(9, 7, 12.0), "triton", torch.float32, settings)
    culled = result.radii == 0
    assert result.is_finite()
    assert culled.any()
    assert not culled.all()
    assert not any(result.gradients[name][culled].any() for name in FIELDS)


@pytest.mark.parametrize("stop", ["inclusive", "exclusive"])
def test_contribution(stop):
    view = camera(17, 13)
    gaussians = random_gaussians(12, view, seed=2)
    settings = SplatSettings(stop=stop, transmittance_min=0.02)
    truth = contribution(gaussians, view, settings=settings, backend="reference")
    counted = contribution(single(gaussians), view, settings=settings, backend="triton")
    torch.testing.assert_close(counted.weight.cpu(), truth.weight, rtol=1e-5, atol=1e-6)
    assert truth.pixels.any()
    assert torch.equal(counted.pixels.cpu(), truth.pixels)
    assert torch.equal(counted.dominant.cpu(), truth.dominant)


def test_of_equal_weights_the_nearer_splat_dominates():
    # 0.5 of everything, then all but a bit of the other half: 0.5 against (1 - 0.5) * 0.99; then 0.25 twice.
    layers = [(0.25, 2.0), (1 / 3, 2.5)]
    gaussians = [one_gaussian(opacities=[o], scales=[[900.0] * 3], means=[[0.0, 0.0, z]]) for o, z in reversed(layers)]
    counted = contribution(single(Gaussians.concatenate(gaussians)), front_camera(1, 1, 40.0), backend="triton")
    near = int(counted.weight[1] >= counted.weight[0])
    assert counted.dominant.tolist() == ([0, 1] if near else [1, 0])
    twice = Gaussians.concatenate([one_gaussian(opacities=[0.0]), *[one_gaussian(opacities=[0.5])] * 2])
    assert contribution(single(twice), front_camera(1, 1, 40.0), backend="triton").dominant.tolist() == [0, 1, 0]


@pytest.mark.parametrize("behind", [False, True], ids=["black", "background"])
def test_removal_against_taking_rows_away(behind):
    # Without a stop rule a pixel is linear in each alpha; alphas below the cut-off stay out with and without a row.
    settings = SplatSettings(transmittance_min=0.0)
    view = camera(9, 7)
    gaussians = random_gaussians(8, view)
    generator = torch.Generator().manual_seed(1)
    background = (
        torch.rand(7, 9, 3, generator=generator, dtype=torch.float64) if behind else torch.zeros(7, 9, 3).double()
    )

    def image(scene: Gaussians) -> torch.Tensor:
        return splat(scene, view, settings=settings, background=background, backend="reference").rgb

    weights = torch.rand(7, 9, generator=generator, dtype=torch.float64) if behind else torch.ones(7, 9).double()

    moved = []
    for row in range(8):
        without = torch.where(torch.arange(8) == row, 0.0, gaussians.opacities)
        moved.append(image(dataclasses.replace(gaussians, opacities=without)) - image(gaussians))
    given = background.to(DEVICE, torch.float32) if behind else None
    found = rasterizer.leave_one_out(
        single(gaussians), given, weights.to(DEVICE, torch.float32) if behind else None, view, settings
    )
    largest = torch.stack([change.abs().max() for change in moved])
    squared = torch.stack([(weights * change.square().sum(-1)).sum() for change in moved])
    assert (largest > 0.01).sum() > 3
    torch.testing.assert_close(found.max_abs_change.cpu(), largest, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found.squared_change.cpu(), squared, rtol=1e-4, atol=1e-6)


def test_no_rows():
    counted = contribution(single(random_gaussians(0, VIEW)), VIEW, backend="triton")
    assert counted.weight.shape == counted.pixels.shape == counted.dominant.shape == (0,)


@pytest.mark.parametrize("laid_out", first_interpreted("transposed", "expanded"))
def test_displacements_in_any_layout(laid_out):
    view = dataclasses.replace(VIEW, shutter=Shutter(torch.full((3,), 0.1), torch.zeros(3)))
    scene = random_gaussians(6, view)
    moved = torch.linspace(-0.5, 0.5, 18, device=DEVICE).view(3, 6).mT
    if laid_out == "expanded":
        moved = torch.tensor([0.3, -0.4, 0.2], device=DEVICE).expand(6, 3)
    assert not moved.is_contiguous()
    strided = dataclasses.replace(single(scene), displacements=moved)
    compact = dataclasses.replace(strided, displacements=moved.contiguous())
    assert torch.equal(splat(strided, view, backend="triton").rgb, splat(compact, view, backend="triton").rgb)
    assert contribution(compact, view, backend="triton").weight.any()
    assert torch.equal(*(contribution(g, view, backend="triton").weight for g in (compact, strided)))
    assert torch.equal(
        *(rasterizer.leave_one_out(g, None, None, view, SplatSettings()).squared_change for g in (compact, strided))
    )


def test_many_tiles_take_wide_keys(monkeypatch):
    monkeypatch.setattr(lists, "_SHORT_KEYS", 2)
    view = camera(19, 17)
    gaussians = random_gaussians(6, view)
    wide = render(gaussians, view, "triton", torch.float32)
    monkeypatch.undo()
    assert_same_bits(wide, render(gaussians, view, "triton", torch.float32))


@pytest.mark.parametrize("dtype", first_interpreted(torch.bfloat16, torch.float16))
def test_autocast_changes_nothing(dtype):
    gaussians = single(random_gaussians(4, VIEW))
    plain = splat(gaussians, VIEW, backend="triton")
    with torch.autocast(DEVICE.type, dtype=dtype):
        inside = splat(gaussians, VIEW, backend="triton")
    assert torch.equal(plain.rgb, inside.rgb)
