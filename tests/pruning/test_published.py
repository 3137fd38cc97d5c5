"""The rules of other papers against their formulas, by hand and by chance; and which of their rows stay."""

import itertools
from collections import Counter

import pytest
import torch

from sparsestreet.pruning import LightGaussianRule, MiniSplattingRule
from sparsestreet.scene.gaussians import Rows
from tests.pruning.test_rules import CONTEXT, frame_of, scene_of

OPACITIES = [0.2, 0.5, 0.6]
WEIGHTS = [0.2, 0.8 * 0.5, 0.8 * 0.5 * 0.6]
"""Of discs across the view, front to back: alpha times the light that the ones before let through, in every pixel."""


def rows_of_volumes(volumes: list[float]) -> Rows:
    """Of which the axes differ: only their product counts."""
    largest = torch.tensor(volumes).log()
    scales = torch.stack((largest + 1.0, torch.full_like(largest, -0.7), torch.full_like(largest, -0.3)), dim=1)
    return Rows({"log_scales": scales})


def test_significance_grows_with_the_volume_up_to_that_of_nine_in_ten():
    volumes = [float(v) for v in range(1, 11)]
    weights = torch.tensor([5.0] * 9 + [2.0], dtype=torch.float64)
    expected = [5.0 * (v / 9) ** 0.1 for v in volumes[:9]] + [2.0]  # the tenth is larger than 90 %: its factor is 1
    scores = LightGaussianRule(keep=0.5).scores("road", rows_of_volumes(volumes), weights)
    # Volumes are float32 logarithms.
    torch.testing.assert_close(scores, torch.tensor(expected, dtype=torch.float64), rtol=1e-6, atol=0)
    flat = LightGaussianRule(keep=0.5, beta=0.0).scores("road", rows_of_volumes(volumes), weights)
    assert torch.equal(flat, weights)


def test_the_most_significant_stay():
    scene = scene_of(OPACITIES, [2.0, 3.0, 4.0])
    frames = [frame_of(scene, offset=5)]
    by_weight = sorted(range(3), key=lambda row: -WEIGHTS[row])
    # Up to 1 a number is a share, so that one row is a little more than 1.
    for number, keep in ((0, 0), (1, 1.01), (2, 2), (3, 1)):
        kept = LightGaussianRule(keep=keep).select(scene, frames, CONTEXT)["background"].keep.tolist()
        assert kept == [row in by_weight[:number] for row in range(3)]
    # The last disc is a hundredth as large in volume: 0.01^0.1 = 0.63, and 0.63 * 0.24 is less than 0.2.
    with torch.no_grad():
        scene.nodes["background"].rows.log_scales[2] -= torch.tensor(100.0).log() / 3
    kept = LightGaussianRule(keep={"background": 2}).select(scene, frames, CONTEXT)["background"].keep
    assert kept.tolist() == [True, True, False]


def test_rows_are_drawn_without_replacement_in_proportion_to_their_importance():
    """Two of four, one after the other: i then j with probability p_i p_j / (1 - p_i)."""
    importance = torch.tensor([1.0, 2.0, 1.0, 12.0], dtype=torch.float64)
    rows, draws = Rows({"log_scales": torch.zeros(4, 3)}), 4000
    found = Counter()
    for seed in range(draws):
        scores = MiniSplattingRule(keep=2, seed=seed).scores("road", rows, importance)
        found[tuple(sorted(scores.topk(2).indices.tolist()))] += 1
    p = (importance / 16).tolist()
    for i, j in itertools.combinations(range(4), 2):
        chance = p[i] * p[j] / (1 - p[i]) + p[j] * p[i] / (1 - p[j])
        # Four standard deviations.
        assert found[i, j] / draws == pytest.approx(chance, abs=4 * (chance * (1 - chance) / draws) ** 0.5)


def test_what_leads_no_pixel_is_drawn_last_unless_the_gate_is_open():
    scene = scene_of(OPACITIES, [2.0, 3.0, 4.0])  # the second leads in every pixel
    frames = [frame_of(scene, offset=5)]

    def kept(number: int, **options) -> set[tuple[int, ...]]:
        rules = (MiniSplattingRule(keep={"background": number + 1e-9}, seed=seed, **options) for seed in range(12))
        return {
            tuple(rule.select(scene, frames, CONTEXT)["background"].keep.nonzero().squeeze(1).tolist())
            for rule in rules
        }

    assert kept(1) == {(1,)}
    assert kept(2) == {(0, 1)}  # no other has importance: of equals the lower row
    assert len(kept(2, gate=False)) == 3


def test_what_fills_many_pixels_counts_for_them_all():
    """Before a disc of opacity 0.4 across the view stands a speck of opacity 0.9 in a few of its 63 pixels."""
    scene = scene_of([0.9, 0.4], [2.0, 3.0])
    with torch.no_grad():
        scene.nodes["background"].rows.log_scales[0] = -4.0
    one = {"background": 1.01}
    frames = [frame_of(scene, offset=5)]
    assert LightGaussianRule(keep=one, beta=0.0).select(scene, frames, CONTEXT)["background"].keep.tolist() == [0, 1]
    drawn = [MiniSplattingRule(keep=one, seed=seed).select(scene, frames, CONTEXT) for seed in range(8)]
    assert sum(bool(selections["background"].keep[1]) for selections in drawn) >= 6  # 0.95 each


def test_a_seed_decides():
    scene = scene_of([0.3] * 6, [2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    frames = [frame_of(scene, offset=5)]

    def kept(seed: int) -> list[bool]:
        rule = MiniSplattingRule(keep={"background": 3}, gate=False, seed=seed)
        return rule.select(scene, frames, CONTEXT)["background"].keep.tolist()

    assert kept(0) == kept(0)
    assert len({tuple(kept(seed)) for seed in range(6)}) > 1


@pytest.mark.parametrize("make", [LightGaussianRule, MiniSplattingRule])
def test_the_floor_holds_and_impossible_numbers_are_refused(make):
    scene = scene_of(OPACITIES, [2.0, 3.0, 4.0], min_gaussians=2)
    selection = make(keep=0.0).select(scene, [frame_of(scene, offset=5)], CONTEXT)["background"]
    assert (int(selection.keep.sum()), selection.floor_hit) == (2, True)
    with pytest.raises(ValueError, match="keep must be a fraction"):
        make(keep=-1)
    with pytest.raises(ValueError, match="beta is an exponent"):
        LightGaussianRule(keep=1, beta=-0.1)
