"""Who is dropped, who stays at the floor, and that both rules are deterministic."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sparsestreet.pruning import keep_by_cost, keep_by_importance, keep_by_mask
from sparsestreet.scene.masks import StaticMask

# A coarse grid, so that ties and hits of the threshold are common.
score_lists = st.lists(st.sampled_from([0.0, 0.005, 0.01, 0.02, 0.5, 0.73, 1.0]), max_size=12)


def by_hand(scores: list[float], unwanted: list[bool], floor: int) -> list[bool]:
    """Remove one row at a time: the lowest, the later of equals, while it is unwanted and the floor allows."""
    keep = [True] * len(scores)
    while sum(keep) > floor:
        row = min((row for row in range(len(scores)) if keep[row]), key=lambda row: (scores[row], -row))
        if not unwanted[row]:
            break
        keep[row] = False
    return keep


@settings(max_examples=300, deadline=None)
@given(score_lists, st.integers(0, 14))
def test_mask_rule_removes_the_lowest_one_by_one(scores, floor):
    selection = keep_by_mask(torch.tensor(scores, dtype=torch.float64), 0.01, floor)
    unwanted = [score <= 0.01 for score in scores]
    assert selection.keep.tolist() == by_hand(scores, unwanted, floor)
    assert selection.removed == len(scores) - int(selection.keep.sum())
    assert selection.floor_hit == (selection.removed < sum(unwanted))


@settings(max_examples=300, deadline=None)
@given(score_lists, st.integers(0, 14))
def test_importance_rule_removes_only_zeros(scores, floor):
    selection = keep_by_importance(torch.tensor(scores, dtype=torch.float64), floor)
    unwanted = [score == 0 for score in scores]
    assert selection.keep.tolist() == by_hand(scores, unwanted, floor)
    assert selection.floor_hit == (selection.removed < sum(unwanted))


@settings(max_examples=100, deadline=None)
@given(score_lists, st.integers(0, 14))
def test_plan_keeps_survivors_in_order_with_their_moments(scores, floor):
    selection = keep_by_mask(torch.tensor(scores), 0.01, floor)
    plan = selection.plan()
    assert plan.source.tolist() == [row for row in range(len(scores)) if selection.keep[row]]
    assert not plan.fresh.any()
    assert not plan.edits
    assert not plan.reset_moments


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-8, 2, width=32), max_size=12, unique=True), st.integers(0, 14))
def test_rows_dropped_are_exactly_those_the_mask_has_closed(logits, floor):
    """LeaveOneOut loses nothing: the rasterizer drew exactly the rows that are kept (scores without ties)."""
    mask = StaticMask(weight=1.0, min_gaussians=floor)
    scores = mask.scores(torch.tensor(logits))
    if len(set(scores.tolist())) == len(logits):
        assert keep_by_mask(scores, mask.threshold, floor).keep.tolist() == (mask.multipliers(scores) == 1).tolist()


def test_score_at_the_threshold_is_closed_in_the_dtype_of_the_mask():
    # float32(0.1) is above 0.1 in float64, so that widening the scores would open the row.
    score = torch.tensor([0.1], dtype=torch.float32)
    assert not keep_by_mask(score, 0.1, 0).keep.item()
    assert StaticMask(weight=1.0, min_gaussians=0, threshold=0.1).multipliers(score).item() == 0.0


def test_all_scores_equal():
    equal = torch.full((5,), 0.004)
    assert keep_by_mask(equal, 0.01, 2).keep.tolist() == [True, True, False, False, False]
    assert keep_by_mask(equal, 0.001, 2).keep.all()
    zeros = torch.zeros(5, dtype=torch.float64)
    selection = keep_by_importance(zeros, 3)
    assert selection.keep.tolist() == [True, True, True, False, False]
    assert selection.floor_hit
    assert selection.removed == 2


@pytest.mark.parametrize("floor", [0, 7])
def test_a_node_without_rows(floor):
    for selection in (keep_by_mask(torch.zeros(0), 0.01, floor), keep_by_importance(torch.zeros(0), floor)):
        assert selection.keep.shape == (0,)
        assert selection.removed == 0
        assert not selection.floor_hit
        assert selection.plan().source.shape == (0,)


def test_floor_above_the_rows_there_are_removes_nothing():
    selection = keep_by_mask(torch.tensor([0.001, 0.5, 0.002]), 0.01, 10)
    assert selection.keep.all()
    assert selection.floor_hit


def test_nan_scores_are_refused():
    scores = torch.tensor([0.5, float("nan")])
    with pytest.raises(ValueError, match="row 1 of 2 is NaN"):
        keep_by_mask(scores, 0.01, 0)
    with pytest.raises(ValueError, match="row 1 of 2 is NaN"):
        keep_by_importance(scores, 0)


def test_impossible_inputs_are_refused():
    with pytest.raises(ValueError, match="min_gaussians"):
        keep_by_mask(torch.zeros(2), 0.01, -1)
    with pytest.raises(ValueError, match=">= 0"):
        keep_by_importance(torch.tensor([-0.1, 0.2]), 0)


@settings(max_examples=200, deadline=None)
@given(score_lists, score_lists, st.floats(0, 3), st.integers(0, 5))
def test_cost_rule_drops_the_cheapest_of_all_nodes_within_the_budget(first, second, allowed, floor):
    costs = {name: torch.tensor(values, dtype=torch.float64) for name, values in (("a", first), ("b", second))}
    chosen = keep_by_cost(costs, allowed, {"a": floor, "b": 0})
    order = sorted(range(len(first) + len(second)), key=lambda row: ((first + second)[row], -row))
    spent, unwanted = 0.0, [False] * len(order)
    for row in order:
        spent += (first + second)[row]
        unwanted[row] = spent <= allowed
    assert chosen["a"].keep.tolist() == by_hand(first, unwanted[: len(first)], floor)
    assert chosen["b"].keep.tolist() == by_hand(second, unwanted[len(first) :], 0)


def test_costs_must_be_numbers():
    for bad in (float("nan"), -1.0):
        with pytest.raises(ValueError, match="costs of removal"):
            keep_by_cost({"a": torch.tensor([1.0, bad])}, 1.0, {"a": 0})
