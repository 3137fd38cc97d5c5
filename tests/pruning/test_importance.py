"""The paper's global importance against a hand-computed case, and the ways it may go wrong."""

import pytest
import torch

from sparsestreet.pruning import Importance
from sparsestreet.ranks import Ranks
from sparsestreet.types import Contribution


def view(weight: list[float], pixels: list[int], dominant: list[int]) -> Contribution:
    counts = torch.tensor([pixels, dominant], dtype=torch.int64)
    return Contribution(torch.tensor(weight, dtype=torch.float64), *counts)


def scores(views: list[Contribution], gate: bool = True) -> torch.Tensor:
    importance = Importance(gate)
    for one in views:
        importance.add(one)
    return importance.scores()


class Twins(Ranks):
    """Two processes that see the same."""

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        return values.mul_(2)


def test_several_processes_divide_by_the_views_of_all():
    importance = Importance()
    importance.add(view([3.0, 1.0], [4, 2], [3, 0]))
    importance.add(view([1.0, 2.0], [4, 4], [1, 2]))
    assert importance.scores(Twins(0, 2)).tolist() == importance.scores().tolist() == [0.5, 0.25]


def test_scores_of_a_hand_computed_case():
    views = [
        # row 0 dominates in both views, 1 in the second only, 2 in none, 3 is never drawn
        view([3.0, 1.0, 0.5, 0.0], [4, 2, 5, 0], [3, 0, 0, 0]),
        view([0.25, 2.0, 0.5, 0.0], [1, 4, 1, 0], [1, 2, 0, 0]),
    ]
    gated = [(3 / 4 + 1 / 4) / 2, (0 + 2 / 4) / 2, 0.0, 0.0]
    assert scores(views, gate=True).tolist() == gated  # halves and quarters are exact
    ungated = [gated[0], (1 / 2 + 2 / 4) / 2, pytest.approx((0.1 + 0.5) / 2, abs=1e-15), 0.0]
    assert scores(views, gate=False).tolist() == ungated


def test_sums_are_float64():
    # In float32 the small view vanishes beside the large one: 1 + 2^-30 == 1.
    found = scores([view([1.0], [1], [1]), view([2.0**-30], [1], [1])])
    assert found.dtype == torch.float64
    assert found.item() * 2 - 1 == 2.0**-30


def test_adding_a_view_does_not_change_earlier_scores():
    importance = Importance()
    importance.add(view([1.0, 2.0], [2, 2], [1, 1]))
    before = importance.scores()
    importance.add(view([5.0, 5.0], [5, 5], [1, 1]))
    assert before.tolist() == [0.5, 1.0]
    assert importance.scores().tolist() == [0.75, 1.0]


def test_a_scene_without_rows_scores_nothing():
    assert scores([view([], [], [])]).shape == (0,)


def test_no_view_is_an_error_not_a_zero_score():
    with pytest.raises(ValueError, match="at least one view"):
        scores([])


def test_views_of_other_rows_are_refused():
    with pytest.raises(ValueError, match="view 1 has 1 and those before 2"):
        scores([view([1.0, 1.0], [1, 1], [1, 1]), view([1.0], [1], [1])])


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -0.5])
def test_poisoned_weights_are_refused(poison):
    with pytest.raises(ValueError, match="row 1 of view 0"):
        scores([view([1.0, poison], [1, 1], [1, 1])])
