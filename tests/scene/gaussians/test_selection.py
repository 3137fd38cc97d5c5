"""What stays above the floor, in the dtype of the scores."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sparsestreet.scene.gaussians import InstanceFloors, keep_best
from tests.scene.gaussians.oracle import by_hand

score_lists = st.lists(st.sampled_from([0.0, 0.005, 0.01, 0.02, 0.5, 0.73, 1.0]), max_size=12)


@pytest.mark.lengthy
@settings(max_examples=300, deadline=None)
@given(score_lists, st.integers(0, 14), st.sampled_from([torch.float32, torch.float64]))
def test_the_lowest_are_removed_one_by_one(scores, floor, dtype):
    values = torch.tensor(scores, dtype=dtype)
    unwanted = values <= torch.tensor(0.01, dtype=dtype)
    selection = keep_best(values, unwanted, floor)
    assert selection.keep.tolist() == by_hand(scores, unwanted.tolist(), floor)
    assert selection.removed == len(scores) - int(selection.keep.sum())
    assert selection.floor_hit == (selection.removed < int(unwanted.sum()))
    plan = selection.plan()
    assert plan.source.tolist() == [row for row in range(len(scores)) if selection.keep[row]]
    assert not plan.fresh.any()
    assert not plan.edits
    assert not plan.reset_moments


@pytest.mark.lengthy
@settings(max_examples=300, deadline=None)
@given(st.data())
def test_each_instance_keeps_its_own_best_and_then_the_node(data):
    """Whatever is unwanted, not only the lowest scores: a rule may rank otherwise than it selects."""
    scores = data.draw(score_lists)
    rows = len(scores)
    unwanted = data.draw(st.lists(st.booleans(), min_size=rows, max_size=rows))
    ids = data.draw(st.lists(st.integers(0, 2), min_size=rows, max_size=rows))
    least = data.draw(st.lists(st.integers(0, 5), min_size=3, max_size=3))
    floor = data.draw(st.integers(0, 14))
    floors = InstanceFloors(torch.tensor(ids, dtype=torch.long), torch.tensor(least))
    selection = keep_best(torch.tensor(scores), torch.tensor(unwanted, dtype=torch.bool), floor, floors)
    assert selection.keep.tolist() == by_hand(scores, unwanted, floor, ids, least)
    assert selection.removed == rows - int(selection.keep.sum())
    assert selection.floor_hit == (selection.removed < sum(unwanted))


def test_of_equals_in_an_instance_the_lower_row_stays():
    floors = InstanceFloors(torch.tensor([1, 0, 1, 0, 1, 0]), torch.tensor([1, 2]))
    everything = torch.ones(6, dtype=torch.bool)
    selection = keep_best(torch.zeros(6), everything, 4, floors)
    # Row 1 of the first instance, rows 0 and 2 of the second, and row 3 for the node.
    assert selection.keep.tolist() == [True, True, True, True, False, False]
    assert keep_best(torch.zeros(6), everything, 3, floors).keep.tolist() == [True, True, True, False, False, False]


def test_an_instance_without_rows_asks_for_nothing():
    floors = InstanceFloors(torch.zeros(0, dtype=torch.long), torch.tensor([3, 0]))
    selection = keep_best(torch.zeros(0), torch.zeros(0, dtype=torch.bool), 2, floors)
    assert (selection.removed, selection.floor_hit) == (0, False)


def test_a_floor_above_the_rows_there_are_removes_nothing():
    selection = keep_best(torch.tensor([0.001, 0.5, 0.002]), torch.tensor([True, False, True]), 10)
    assert selection.keep.all()
    assert selection.floor_hit
    assert selection.removed == 0


def test_nan_scores_and_a_negative_floor_are_refused():
    nothing = torch.zeros(2, dtype=torch.bool)
    with pytest.raises(ValueError, match="row 1 of 2 is NaN"):
        keep_best(torch.tensor([0.5, float("nan")]), nothing, 0)
    with pytest.raises(ValueError, match="min_gaussians must be >= 0, got -1"):
        keep_best(torch.zeros(2), nothing, -1)
