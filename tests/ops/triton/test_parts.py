"""Long tiles in parts: the same image and gradients as in one piece, for any length of the parts."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sparsestreet.ops import SplatSettings, contribution, splat
from sparsestreet.ops.triton import pixels, rasterizer
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.types import Gaussians
from tests.ops.scenes import (
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
from tests.ops.triton.splitting import Rule, part_length, split_by, split_length
from tests.ops.triton.tile_lists import lists_of

DEVICE = device_of("triton")
STOPS = {
    "inclusive": SplatSettings(transmittance_min=0.02),
    "exclusive": SplatSettings(stop="exclusive", transmittance_min=0.02),
    "never": SplatSettings(transmittance_min=0.0),
}


def stack(count: int, opacity: float = 0.3) -> Gaussians:
    """Tilted splats behind each other in the left tile of two, and a single one in the right tile."""
    rows = [
        one_gaussian(
            means=[[0.02 * k - 0.5, 0.01 * k, 2.0 + 0.02 * k]],
            quaternions=[[0.9, 0.2, -0.3, 0.1 + 0.01 * k]],
            scales=[[0.3, 0.2, 0.25]],
            opacities=[opacity],
            sh=[[[0.3 - 0.02 * k, 0.02 * k, 0.1]]],
        )
        for k in range(count)
    ]
    return Gaussians.concatenate([one_gaussian(means=[[0.6, 0.0, 2.0]], sh=[[[0.5, 0.2, 0.1]]]), *rows])


VIEW = front_camera(27, 11, 22.0)


@pytest.fixture
def short_parts():
    with split_by(Rule(min_part_pairs=3)):
        yield


@pytest.mark.parametrize("name", first_interpreted(*STOPS))
def test_against_the_reference(name, short_parts):
    scene, seen = stack(10), []
    truth = render(scene, VIEW, "reference", torch.float64, STOPS[name])
    original = rasterizer.blend_view

    def watched(*args, **kwargs):
        seen.append(original(*args, **kwargs))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rasterizer, "blend_view", watched)
        result = render(scene, VIEW, "triton", torch.float32, STOPS[name])
    used = seen[0].ends.parts
    assert used is not None
    # Some pixels end before the last part, where the stop rule has one; others reach it.
    closed = used.lasts.view(-1, 256).amin(-1) == used.lasts.view(-1, 256).amax(-1)
    assert not closed.all()
    for image in ("rgb", "alpha"):
        assert (result.images[image] - truth.images[image]).abs().max() <= 1e-6, image
    assert relative_error(result.images["depth"], truth.images["depth"]) <= 1e-6
    for field, gradient in truth.gradients.items():
        assert relative_error(result.gradients[field], gradient) <= 1e-5, field


@pytest.mark.parametrize("length", first_interpreted(4, 1))
def test_any_length_draws_the_same(length):
    view = camera(19, 17)
    scene = random_gaussians(12, view)
    whole = render(scene, view, "triton", torch.float32)
    with split_by(Rule(min_part_pairs=length, min_parts=2)):
        split = render(scene, view, "triton", torch.float32)
    for name, image in whole.images.items():
        torch.testing.assert_close(split.images[name], image, rtol=1e-6, atol=1e-6)
    for field, gradient in whole.gradients.items():
        assert relative_error(split.gradients[field], gradient) <= 1e-5, field


def test_each_launch_does_what_no_other_does(short_parts, poisoned, monkeypatch):
    """Whole tiles, first parts and what later ones let through; then these, but nothing behind the last of a tile."""
    started, blended, multiplied = pixels.launch, [], []

    def launch(kernel, items, block, *arguments, **options):
        started(kernel, items, block, *arguments, **options)
        given = dict(zip(kernel.arg_names, arguments, strict=False))
        rgb, products = given["part_rgb"], given["products"]
        for written, layer in ((blended, rgb.view(-1, 768)), (multiplied, products.view(-1, 256))):
            finite = layer.isfinite()
            assert torch.equal(finite.all(1), finite.any(1))
            written.append(finite.all(1))
        rgb.fill_(torch.nan if len(blended) == 1 else 0.0)

    view = KernelView(VIEW, SplatSettings())
    screen = rasterizer.project(cast(stack(13), torch.float32, device=DEVICE), view)
    monkeypatch.setattr(pixels, "launch", launch)
    layers, split = pixels.blend_view(screen, view, lasts=False), screen.lists.parts
    assert split is not None
    assert layers.rgb.isfinite().all()
    part = torch.arange(len(split), device=DEVICE)
    first, last, used = split.firsts == part, split.nexts == part + 1, split.nexts > part
    assert int(used.sum()) > int((first & used).sum()) + int((last & used).sum()) > 0
    assert torch.equal(blended[0], used & first)
    assert torch.equal(blended[1], used & ~first)
    assert torch.equal(multiplied[0], used & ~last)
    assert torch.equal(multiplied[1], used & ~last)


def test_counting_and_removal_walk_whole_tiles(short_parts):
    scene = stack(13)
    single = cast(scene, torch.float32, device=DEVICE)
    truth = contribution(scene, VIEW, backend="reference")
    counted = contribution(single, VIEW, backend="triton")
    assert torch.equal(counted.dominant.cpu(), truth.dominant)
    with split_by(Rule()):
        whole = rasterizer.leave_one_out(single, None, None, VIEW, SplatSettings())
    split = rasterizer.leave_one_out(single, None, None, VIEW, SplatSettings())
    torch.testing.assert_close(split.squared_change, whole.squared_change, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(split.max_abs_change, whole.max_abs_change, rtol=1e-5, atol=1e-7)


def test_parts_longer_than_a_look():
    # Both parts hold 35 splats and are looked at after 32, when half the light still passes.
    layers = [
        one_gaussian(means=[[0.0, 0.0, 2 + 0.1 * k]], scales=[[90.0] * 3], opacities=[0.02], sh=[[[0.01 * k] * 3]])
        for k in range(70)
    ]
    scene, view = Gaussians.concatenate(layers), front_camera(3, 2, 20.0)
    with split_by(Rule(min_part_pairs=33, min_parts=2)):
        drawn = splat(cast(scene, torch.float32, device=DEVICE), view, backend="triton")
    truth = splat(scene, view, backend="reference")
    assert (drawn.rgb.cpu() - truth.rgb).abs().max() < 1e-6


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=9),
    st.integers(1, 7),
    st.integers(1, 12),
    st.integers(2, 4),
    st.integers(0, 40),
)
# More parts, and more tiles, than a program has lanes.
@example([300], 1, 400, 3, 0)
@example([5] + [0] * 299, 2, 12, 2, 9)
# Tiles of a class in three programs.
@example([7, 3, 0] * 200, 2, 12, 2, 0)
def test_parts_cover_long_tiles_once(counts, length, limit, fewest, more):
    pairs = sum(counts)
    with split_by(Rule(max_parts=limit, min_part_pairs=length, min_parts=fewest)):
        share, least = part_length(pairs), split_length(pairs)
        begins, ends, order, found = lists_of(counts, pairs + more)
    assert ends.tolist() == torch.tensor(counts).cumsum(0).tolist()

    def key(tile: int) -> tuple[float, int]:
        return -math.floor(math.log2(counts[tile] / least)) if counts[tile] else math.inf, tile

    assert order.tolist() == sorted(range(len(counts)), key=key)
    long = [tile for tile, count in enumerate(counts) if count >= least]
    if found is None:
        assert not long
        return
    assert len(found) < limit + 4  # in fours
    starts = [4 * counts[tile] >= least for tile in order] + [False]
    assert int(found.ahead[0]) in [place for place in range(len(counts) + 1) if not starts[place]]
    assert all(starts[: int(found.ahead[0])][-1:])
    listed: dict[int, list[int]] = {}
    for part, (tile, begin, end) in enumerate(zip(found.tiles, found.begins, found.ends, strict=True)):
        if found.nexts[part] > part:
            assert share <= int(end - begin) < (fewest + 1) / fewest * share + 1
            listed.setdefault(int(tile), []).extend(range(int(begin), int(end)))
            first, following = int(found.firsts[part]), int(found.nexts[part])
            assert following - first >= fewest
            assert (found.tiles[first:following] == tile).all()
        else:
            assert begin == end
            assert found.firsts[part] == part
    assert listed == {tile: list(range(int(begins[tile]), int(ends[tile]))) for tile in long}
    assert [int(end) for end in found.whole_ends] == [
        int(begins[tile] if tile in long else ends[tile]) for tile in range(len(counts))
    ]


STREETS = [
    ({0: 0, 0.1: 40, 0.5: 529, 0.65: 800, 0.8: 1350, 0.9: 2268, 0.99: 3473, 1: 4958}, 2400),
    ({0: 0, 0.1: 25, 0.5: 421, 0.65: 700, 0.8: 1150, 0.9: 2108, 0.97: 2900, 0.99: 4494, 1: 7925}, 2160),
]
"""Quantiles of the pairs of a tile, as counted on trained streets, and numbers of tiles."""


@pytest.mark.parametrize(("quantiles", "tiles"), STREETS)
def test_no_chain_of_a_street_is_longer_than_the_devices_share(quantiles, tiles):
    """1.3 times what each of the 2640 warps of a large GPU has of all pairs; what a part lets through counts too."""
    at = (np.arange(tiles) + 0.5) / tiles
    lengths = np.random.default_rng(0).permutation(np.interp(at, [*quantiles], [*quantiles.values()]).round())
    begins, _, _, found = lists_of(lengths.astype(int).tolist())
    assert found is not None
    chains = [*(found.whole_ends - begins).tolist(), *(2 * (found.ends - found.begins)).tolist()]
    assert max(chains) <= 1.3 * lengths.sum() / 2640


def test_no_tile_is_split_of_many_alike():
    """Means of 300 to 6,000 pairs; fluctuations of a sixth."""
    assert all(7 * mean // 6 <= split_length(mean * tiles) for mean in (300, 1000, 6000) for tiles in (2400, 9600))
