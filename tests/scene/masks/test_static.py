"""Scores, multipliers and what is kept: values, gradients, thresholds and the floor."""

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.masks import straight_through
from sparsestreet.scene.masks.static import lowered_threshold
from tests.scene.street import static_mask

# A coarse grid, so that ties and hits of the threshold are common; sigmoid(-150) is 0 in float32.
GRID = [-150.0, -6.0, -4.5, -4.0, 0.0, 1.0, 30.0]
logit_lists = st.lists(st.sampled_from(GRID), max_size=12)


def rows_of(logits: list[float] | torch.Tensor) -> Rows:
    """A table of nothing but a mask's column."""
    return Rows({"mask_logits": torch.as_tensor(logits, dtype=torch.float32)}, transient=["mask_logits"])


def score_of(logit: float) -> float:
    """The score of a logit as the mask knows it."""
    return float(static_mask().scores(rows_of([logit])).detach())


def rows_with(scores: list[float]) -> Rows:
    """Rows whose scores come near the given ones."""
    return rows_of(torch.tensor(scores, dtype=torch.float64).logit())


def opened(mask, rows: Rows) -> list[float]:
    return mask.multipliers(rows, 0.5).tolist()


def test_one_sigmoid_only():
    logits = [-30.0, -4.6, 0.0, 1.0, 7.5]
    expected = torch.tensor([1 / (1 + math.exp(-x)) for x in logits])
    torch.testing.assert_close(static_mask().scores(rows_of(logits)).detach(), expected, rtol=1e-6, atol=0)


def test_the_start_is_the_logit_1_everywhere():
    mask = static_mask()
    (logits,) = mask.initial_columns(3).values()
    assert list(mask.initial_columns(3)) == list(mask.columns) == ["mask_logits"]
    assert logits.dtype == torch.float32
    assert logits.tolist() == [1.0] * 3
    assert opened(mask, rows_of(logits)) == [1.0] * 3


def test_strictly_above_the_threshold():
    mask = static_mask(threshold=score_of(-1.0))
    assert opened(mask, rows_of([-150.0, -1.0, -1.0 + 2**-20, 30.0])) == [0.0, 0.0, 1.0, 1.0]


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
    mask, rows = static_mask(), rows_of([-4.6, -4.59])
    with torch.autocast("cpu", torch.bfloat16):
        scores = mask.scores(rows)
    assert scores.dtype == torch.float32
    assert scores[0] < scores[1]
    assert mask.scores(rows.bfloat16()).dtype == torch.float32


@pytest.mark.parametrize(("floor", "open_rows"), [(0, [0]), (1, [0]), (2, [0, 3]), (3, [0, 1, 3]), (5, [0, 1, 2, 3])])
def test_the_best_rows_reopen_below_the_floor(floor: int, open_rows: list[int]):
    multipliers = static_mask(floor).multipliers(rows_with([0.5, 0.002, 0.001, 0.003]), 0.5)
    assert torch.nonzero(multipliers).flatten().tolist() == open_rows


def test_a_floor_that_holds_is_counted():
    mask, rows = static_mask(2), rows_with([0.5, 0.002, 0.001])
    for firings in (1, 2):
        mask.multipliers(rows, 0.5)
        assert mask.floor_firings == firings
    mask.multipliers(rows_with([0.5, 0.6, 0.001]), 0.5)
    mask.keep(rows)
    assert mask.floor_firings == 2
    assert static_mask(2).floor_firings == 0


@pytest.mark.parametrize("threshold", [0.0, 0.3, 0.5])
def test_a_threshold_that_no_host_looked_at_closes_the_same_rows(threshold: float):
    """As on a device, where the number of rows that pass is not read: by sorting, with ties and at every floor."""
    scores = torch.rand(40, generator=torch.Generator().manual_seed(3)).mul(20).floor().div(20)
    best_first = scores.sort(descending=True).values
    passing = int((scores > threshold).sum())
    for floor in range(1, 41):
        lowered, fires = lowered_threshold(scores, threshold, floor)
        expected = scores > threshold if passing >= floor else scores >= best_first[floor - 1]
        assert torch.equal(scores > lowered, expected)
        assert bool(fires) == (passing < floor)
        assert passing < floor or float(lowered) == torch.tensor(threshold)


def test_ties_at_the_floor_all_stay_open():
    assert opened(static_mask(2), rows_of([-6.9] * 5)) == [1.0] * 5


def test_scores_of_zero_can_reopen():
    """sigma(-200) is 0 in float32; the threshold has to go below it."""
    assert opened(static_mask(1), rows_of([-200.0] * 3)) == [1.0] * 3


@pytest.mark.lengthy
@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-8, 2, width=32), max_size=12, unique=True), st.integers(0, 14))
def test_rows_dropped_are_exactly_those_the_mask_has_closed(logits, floor):
    """Removal loses nothing: the rasterizer drew exactly the rows that are kept (scores without ties)."""
    mask, rows = static_mask(floor), rows_of(logits)
    if len(set(mask.scores(rows).tolist())) == len(logits):
        assert mask.keep(rows).keep.tolist() == (mask.multipliers(rows, 0.5) == 1).tolist()


def test_a_score_at_the_threshold_is_closed_for_both():
    """float32(sigma) compared in float64 with a threshold of float64 would open the row in one of the two."""
    threshold = 0.1
    rows = rows_with([threshold])
    assert score_of(float(rows.mask_logits.detach())) == float(torch.tensor(threshold, dtype=torch.float32))
    mask = static_mask(threshold=threshold)
    assert not mask.keep(rows).keep.item()
    assert opened(mask, rows) == [0.0]


def test_all_scores_equal():
    equal = rows_of([-5.5] * 5)  # 0.004
    assert static_mask(2).keep(equal).keep.tolist() == [True, True, False, False, False]
    assert static_mask(2, threshold=0.001).keep(equal).keep.all()


@pytest.mark.parametrize("floor", [0, 7])
def test_a_node_without_rows(floor: int):
    mask = static_mask(floor)
    selection = mask.keep(rows_of([]))
    assert selection.keep.shape == (0,)
    assert selection.removed == 0
    assert not selection.floor_hit
    assert selection.plan().source.shape == (0,)
    assert opened(mask, rows_of([])) == []
    assert mask.sparsity(rows_of([]), 0.5, torch.zeros(0, dtype=torch.bool)).item() == 0.0
