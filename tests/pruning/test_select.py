"""Who is dropped, who stays at the floor, and that both rules are deterministic."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from sparsestreet.pruning import Floors, keep_by_cost, keep_by_importance, keep_by_rank
from tests.scene.gaussians.oracle import by_hand

# A coarse grid, so that ties are common.
score_lists = st.lists(st.sampled_from([0.0, 0.005, 0.01, 0.02, 0.5, 0.73, 1.0]), max_size=12)


@pytest.mark.lengthy
@settings(max_examples=300, deadline=None)
@given(score_lists, st.integers(0, 14))
def test_importance_rule_removes_only_zeros(scores, floor):
    selection = keep_by_importance(torch.tensor(scores, dtype=torch.float64), Floors(floor))
    unwanted = [score == 0 for score in scores]
    assert selection.keep.tolist() == by_hand(scores, unwanted, floor)
    assert selection.floor_hit == (selection.removed < sum(unwanted))


def test_all_scores_equal():
    selection = keep_by_importance(torch.zeros(5, dtype=torch.float64), Floors(3))
    assert selection.keep.tolist() == [True, True, True, False, False]
    assert selection.floor_hit
    assert selection.removed == 2


@pytest.mark.parametrize("floor", [0, 7])
def test_a_node_without_rows(floor):
    selection = keep_by_importance(torch.zeros(0), Floors(floor))
    assert selection.keep.shape == (0,)
    assert selection.removed == 0
    assert not selection.floor_hit
    assert selection.plan().source.shape == (0,)


@pytest.mark.lengthy
@settings(max_examples=200, deadline=None)
@given(score_lists, score_lists, st.floats(0, 3), st.integers(0, 5))
def test_cost_rule_drops_the_cheapest_of_all_nodes_within_the_budget(first, second, allowed, floor):
    costs = {name: torch.tensor(values, dtype=torch.float64) for name, values in (("a", first), ("b", second))}
    chosen = keep_by_cost(costs, allowed, {"a": Floors(floor), "b": Floors(0)})
    order = sorted(range(len(first) + len(second)), key=lambda row: ((first + second)[row], -row))
    spent, unwanted = 0.0, [False] * len(order)
    for row in order:
        spent += (first + second)[row]
        unwanted[row] = spent <= allowed
    assert chosen["a"].keep.tolist() == by_hand(first, unwanted[: len(first)], floor)
    assert chosen["b"].keep.tolist() == by_hand(second, unwanted[len(first) :], 0)


@pytest.mark.lengthy
@settings(max_examples=200, deadline=None)
@given(score_lists, score_lists, st.floats(0, 1), st.integers(0, 5))
def test_rank_rule_drops_a_number_of_the_lowest_of_all_nodes(first, second, share, floor):
    number = round(share * len(first + second))
    scores = {name: torch.tensor(values, dtype=torch.float64) for name, values in (("a", first), ("b", second))}
    chosen = keep_by_rank(scores, number, {"a": Floors(floor), "b": Floors(0)})
    order = sorted(range(len(first) + len(second)), key=lambda row: ((first + second)[row], -row))
    unwanted = [row in order[:number] for row in range(len(order))]
    assert chosen["a"].keep.tolist() == by_hand(first, unwanted[: len(first)], floor)
    assert chosen["b"].keep.tolist() == by_hand(second, unwanted[len(first) :], 0)


def test_an_order_of_its_own_spends_the_same_budget():
    """By hand: 0.3 of row 2 goes first, then 0.2 makes it 0.5; a floor keeps what would go last."""
    costs, order = {"a": torch.tensor([0.1, 0.2, 0.3])}, {"a": torch.tensor([3.0, 2.0, 1.0])}
    assert keep_by_cost(costs, 0.4, {"a": Floors(0)}, order)["a"].keep.tolist() == [True, True, False]
    assert keep_by_cost(costs, 0.51, {"a": Floors(0)}, order)["a"].keep.tolist() == [True, False, False]
    assert keep_by_cost(costs, 9.0, {"a": Floors(1)}, order)["a"].keep.tolist() == [True, False, False]


def test_without_nodes_nothing_is_chosen():
    assert keep_by_cost({}, 1.0, {}) == {}
    assert keep_by_rank({}, 0, {}) == {}


def test_a_budget_may_be_met_exactly():
    costs = {"a": torch.tensor([0.25, 0.5, 0.25], dtype=torch.float64)}
    assert keep_by_cost(costs, 0.5, {"a": Floors(0)})["a"].keep.tolist() == [False, True, False]
    assert keep_by_cost(costs, 0.49, {"a": Floors(0)})["a"].keep.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("choose", "said"),
    [
        (lambda: keep_by_importance(torch.tensor([0.5, float("nan")]), Floors(0)), "row 1 of 2 is NaN"),
        (lambda: keep_by_importance(torch.tensor([-0.1, 0.2]), Floors(0)), ">= 0"),
        (lambda: keep_by_importance(torch.zeros(2), Floors(-1)), "min_gaussians"),
        (lambda: keep_by_rank({"a": torch.ones(2)}, -1, {"a": Floors(0)}), "have 2"),
        (lambda: keep_by_rank({"a": torch.ones(2)}, 3, {"a": Floors(0)}), "have 2"),
        (lambda: keep_by_cost({"a": torch.tensor([1.0, float("nan")])}, 1.0, {"a": Floors(0)}), "costs of removal"),
        (lambda: keep_by_cost({"a": torch.tensor([1.0, -1.0])}, 1.0, {"a": Floors(0)}), "costs of removal"),
    ],
)
def test_impossible_numbers_are_refused(choose, said):
    with pytest.raises(ValueError, match=said):
        choose()
