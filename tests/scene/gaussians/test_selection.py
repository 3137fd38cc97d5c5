"""What stays above the floor, in the dtype of the scores."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sparsestreet.scene.gaussians import keep_best
from tests.scene.gaussians.oracle import by_hand

score_lists = st.lists(st.sampled_from([0.0, 0.005, 0.01, 0.02, 0.5, 0.73, 1.0]), max_size=12)


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
