import math

import pytest
import torch

from sparsestreet.scene.masks import StaticMask, straight_through


def test_one_sigmoid_only():
    logits = [-30.0, -4.6, 0.0, 1.0, 7.5]
    scores = StaticMask(weight=1.0, min_gaussians=0).scores(torch.tensor(logits))
    expected = torch.tensor([1 / (1 + math.exp(-x)) for x in logits])
    torch.testing.assert_close(scores, expected, rtol=1e-6, atol=0)


def test_everything_can_be_pruned():
    """Two sigmoids would never fall below 0.5, far above the threshold."""
    mask = StaticMask(weight=1.0, min_gaussians=0)
    scores = mask.scores(torch.full((4,), -5.0))
    assert mask.multipliers(scores).tolist() == [0.0] * 4


def test_the_start_is_the_logit_1_everywhere():
    mask = StaticMask(weight=1.0, min_gaussians=0)
    logits = mask.initial_logits(3)
    assert logits.dtype == torch.float32
    assert logits.tolist() == [1.0] * 3
    assert mask.multipliers(mask.scores(logits)).tolist() == [1.0] * 3


def test_strictly_above_the_threshold():
    mask = StaticMask(weight=1.0, min_gaussians=0, threshold=0.25)
    scores = torch.tensor([0.0, 0.25, 0.25 + 2**-20, 1.0])
    assert mask.multipliers(scores).tolist() == [0.0, 0.0, 1.0, 1.0]


def test_values_are_exactly_0_and_1_for_any_score():
    scores = torch.rand(10_000, generator=torch.Generator().manual_seed(0))
    assert set(straight_through(scores, 0.3).tolist()) == {0.0, 1.0}


def test_gradient_passes_through_open_and_closed_rows_alike():
    scores = torch.tensor([0.001, 0.2, 0.9], requires_grad=True)
    cotangent = torch.tensor([0.7, -1.3, 2.1])
    (gradient,) = torch.autograd.grad(straight_through(scores, 0.01), scores, cotangent)
    assert torch.equal(gradient, cotangent)


def test_scores_stay_float32_under_bfloat16():
    """Near -4.6 bfloat16 logits are 1/32 apart, and an Adam step of 0.01 would be lost."""
    mask = StaticMask(weight=1.0, min_gaussians=0)
    logits = torch.tensor([-4.6, -4.59])
    with torch.autocast("cpu", torch.bfloat16):
        scores = mask.scores(logits)
    assert scores.dtype == torch.float32
    assert scores[0] < scores[1]
    assert mask.scores(logits.bfloat16()).dtype == torch.float32


@pytest.mark.parametrize(("floor", "open_rows"), [(0, [0]), (1, [0]), (2, [0, 3]), (3, [0, 1, 3]), (5, [0, 1, 2, 3])])
def test_the_best_rows_reopen_below_the_floor(floor: int, open_rows: list[int]):
    mask = StaticMask(weight=1.0, min_gaussians=floor)
    scores = torch.tensor([0.5, 0.002, 0.001, 0.003])
    assert torch.nonzero(mask.multipliers(scores)).flatten().tolist() == open_rows


def test_ties_at_the_floor_all_stay_open():
    mask = StaticMask(weight=1.0, min_gaussians=2)
    assert mask.multipliers(torch.full((5,), 0.001)).tolist() == [1.0] * 5


def test_scores_of_zero_can_reopen():
    """sigma(-200) is 0 in float32; the threshold has to go below it."""
    mask = StaticMask(weight=1.0, min_gaussians=1)
    assert mask.multipliers(mask.scores(torch.full((3,), -200.0))).tolist() == [1.0] * 3
