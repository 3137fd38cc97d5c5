"""Where long tiles are split, on the lengths of tiles of trained streets, with a model of the device."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sparsestreet.ops.triton.parts import split_length
from tests.ops.triton.device_model import (
    BACKWARD,
    FORWARD,
    WARPS,
    Split,
    four_launches,
    lengths_of,
    makespan,
    together,
    two_launches,
)
from tests.ops.triton.splitting import Rule, split_by
from tests.ops.triton.tile_lists import lists_of

# Pairs of a tile, counted on views of two trained streets: ten front views of one, scaled to the mean of a street of
# 1.6 M splats at 960x640; one view of the other, each splat replaced by nine. The median, 90 %, 99 % and the longest
# were counted; those between are chosen so that the mean is the counted one.
STREETS = {
    "ten views": ({0: 0, 0.1: 40, 0.5: 529, 0.65: 800, 0.8: 1350, 0.9: 2268, 0.99: 3473, 1: 4958}, 2400),
    "one view": ({0: 0, 0.1: 25, 0.5: 421, 0.65: 700, 0.8: 1150, 0.9: 2108, 0.97: 2900, 0.99: 4494, 1: 7925}, 2160),
    "ten views, 1920x1280": ({0: 0, 0.1: 40, 0.5: 529, 0.65: 800, 0.8: 1350, 0.9: 2268, 0.99: 3473, 1: 4958}, 9600),
}
UNSPLIT = Rule(max_parts=1)


def split(lengths: NDArray[np.int64]) -> Split:
    """As the lists of a view with these tiles split them."""
    begins, ends, order, found = lists_of(lengths.tolist())
    if found is None:
        return Split(lengths[order.cpu()].tolist(), [], 0)
    parts: dict[int, list[int]] = {}
    for first, begin, end in zip(found.firsts.tolist(), found.begins.tolist(), found.ends.tolist(), strict=True):
        if begin < end:
            parts.setdefault(first, []).append(end - begin)
    whole = (found.whole_ends - begins)[order].tolist()
    assert sum(whole) + sum(map(sum, parts.values())) == int(lengths.sum()) == int(ends[-1])
    return Split(whole, list(parts.values()), int(found.ahead[0]))


@pytest.mark.parametrize(("name", "mean", "longest"), [("ten views", 875, 5.7), ("one view", 804, 9.9)])
def test_the_streets_have_the_tiles_that_were_counted(name, mean, longest):
    lengths = lengths_of(*STREETS[name])
    assert lengths.mean() == pytest.approx(mean, rel=0.05)
    assert lengths.max() / lengths.mean() == pytest.approx(longest, rel=0.06)


def test_the_model_repeats_a_record():
    """1.5 M random splats at 960x640: pixels took 0.54 ms. Tiles close after 535 of their pairs, the last after 928."""
    walked = np.random.default_rng(0).normal(535, 120, 2400).clip(0, 928)
    walked[0] = 928
    for fit in FORWARD:
        assert makespan(walked.tolist(), fit) == pytest.approx(0.54, rel=0.35)


def test_the_model_by_hand():
    # Alone at once; two on one scheduler after the first of all; a third waits for a place.
    assert makespan([100.0], (0.4, 0.1)) == pytest.approx(0.05)
    full = [100.0] * (132 * 4)
    assert makespan([*full, 50.0], (0.4, 0.1)) == pytest.approx(1e-3 * (50 * 0.6 + 50 * 0.5))
    assert makespan([*full, 50.0], (0.4, 0.1), resident=1) == pytest.approx(1e-3 * 150 * 0.5)


@pytest.mark.parametrize("name", STREETS)
def test_no_chain_is_longer_than_the_devices_share(name):
    """1.3 times what a warp of a large GPU has of all pairs, where the least length of a part is no bound."""
    lengths = lengths_of(*STREETS[name])
    found = split(lengths)
    assert found.parts
    assert min(map(len, found.parts)) >= Rule().min_parts
    assert max(found.chains) <= 1.3 * lengths.sum() / WARPS


def test_small_views_are_split_to_occupy_a_device():
    """240 tiles (320x192)."""
    found = split(lengths_of(STREETS["one view"][0], 240) * 7 // 10)
    assert max(found.chains) <= Rule().min_parts * 128
    assert len(found.whole) + sum(map(len, found.parts)) > 1000


@pytest.mark.parametrize("tiles", [2400, 9600])
def test_no_tile_is_split_of_many_alike(tiles):
    """Means of 300 to 6,000 pairs; fluctuations of a sixth."""
    assert all(7 * mean // 6 <= split_length(mean * tiles) for mean in (300, 1000, 6000))


@pytest.mark.parametrize("name", ["ten views", "one view"])
def test_a_street_takes_half_the_time_with_its_tiles_split(name):
    lengths = lengths_of(*STREETS[name])
    found, four_means = split(lengths), round(2 * lengths.mean())
    with split_by(UNSPLIT):
        whole = split(lengths)
    # The rule that was measured: from four times the mean on, into parts of at least twice the mean.
    with split_by(Rule(max_parts=-(-int(lengths.sum()) // four_means), min_parts=2)):
        measured = split(lengths)
    assert whole.parts == []
    for fit in FORWARD:
        assert four_launches(found, fit) < 0.75 * makespan(whole.whole, fit)
        assert four_launches(measured, fit) > 1.9 * four_launches(found, fit)
    for fit in BACKWARD:
        parts = [pairs for parts in found.parts for pairs in parts]
        assert makespan(found.whole, fit) + makespan(parts, fit) < 0.6 * makespan(whole.whole, fit)


@pytest.mark.parametrize("name", STREETS)
def test_parts_and_whole_tiles_start_together(name):
    """What is as long as a part or longer starts before the parts, the rest after them: both orders take longer."""
    lengths = lengths_of(*STREETS[name])
    found = split(lengths)
    # Of a split tile nothing is left.
    ahead = [pairs for pairs in found.whole[: found.ahead] if pairs]
    assert min(ahead) >= split_length(int(lengths.sum())) / 4 > max(found.whole[found.ahead :])
    for fit in FORWARD:
        assert two_launches(found, fit) < 0.95 * four_launches(found, fit)
    for fit in BACKWARD:
        parts = [pairs for parts in found.parts for pairs in parts]
        one = makespan(together(found, parts), fit)
        assert one < 0.85 * (makespan(found.whole, fit) + makespan(parts, fit))
        assert one < 1.03 * min(makespan([*found.whole, *parts], fit), makespan([*parts, *found.whole], fit))
