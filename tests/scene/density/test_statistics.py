"""Accumulation over views against a hand-computed case, and rows that come and go."""

import pytest
import torch

from sparsestreet.scene.density import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan


def test_gradients_are_per_half_image_and_averaged_over_visits():
    statistics = DensityStatistics(3)
    # 640x400: (3/320, 4/200) per pixel is (3, 4) per half image, norm 5.
    statistics.add(
        torch.tensor([[3 / 320, 4 / 200], [1.0, 1.0], [0.0, 0.0]]), torch.tensor([32.0, 0.0, 64.0]), 640, 400
    )
    # 200x500: the longer side is the height now.
    statistics.add(torch.tensor([[0.0, 1 / 250], [2 / 100, 0.0], [0.0, 0.0]]), torch.tensor([50.0, 5.0, 0.0]), 200, 500)
    # Row 1 was not drawn in the first view: its gradient there does not count, and it has one visit.
    torch.testing.assert_close(statistics.mean_gradients(), torch.tensor([(5 + 1) / 2, 2.0, 0.0]))
    assert statistics.visits.tolist() == [2, 1, 1]
    torch.testing.assert_close(statistics.largest_screen, torch.tensor([0.1, 0.01, 0.1]))


def test_gradient_of_an_undrawn_row_may_be_anything():
    statistics = DensityStatistics(2)
    nan = float("nan")
    statistics.add(torch.tensor([[nan, nan], [1.0, 0.0]]), torch.tensor([0.0, 1.0]), 2, 2)
    assert statistics.mean_gradients().tolist() == [0.0, 1.0]


def test_a_drawn_row_whose_gradient_is_not_finite_has_no_say():
    statistics = DensityStatistics(3)
    for value in (torch.nan, torch.inf):
        statistics.add(torch.tensor([[0.0, 0.0], [value, 0.0], [3.0, 0.0]]), torch.ones(3), 2, 2)
    assert statistics.mean_gradients().tolist() == [0.0, 0.0, 3.0]
    assert statistics.visits.tolist() == [2, 0, 2]


def test_a_sum_that_overflows_is_refused():
    statistics = DensityStatistics(2)
    for _ in range(2):
        statistics.add(torch.tensor([[0.0, 0.0], [3e38, 0.0]]), torch.tensor([1.0, 1.0]), 2, 2)
    with pytest.raises(ValueError, match="row 1 of 2"):
        statistics.mean_gradients()


def test_resize_follows_the_rows_and_starts_fresh_ones_at_zero():
    statistics = DensityStatistics(3)
    statistics.add(torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]), torch.tensor([1.0, 2.0, 3.0]), 2, 2)
    statistics.resize(RowPlan(3, torch.tensor([2, 0, 2]), torch.tensor([False, False, True])))
    assert statistics.mean_gradients().tolist() == [3.0, 1.0, 0.0]
    assert statistics.visits.tolist() == [1, 1, 0]
    assert statistics.largest_screen.tolist() == [1.5, 0.5, 0.0]
    assert len(statistics) == 3


def test_a_checkpoint_continues_where_it_was_with_its_own_number_of_rows():
    statistics = DensityStatistics(3)
    statistics.add(torch.rand(3, 2), torch.tensor([1.0, 0.0, 2.0]), 7, 5)
    resumed = DensityStatistics.from_state(statistics.state_dict())
    view = (torch.rand(3, 2), torch.ones(3), 7, 5)
    statistics.add(*view)
    resumed.add(*view)
    assert torch.equal(resumed.mean_gradients(), statistics.mean_gradients())
    assert torch.equal(resumed.largest_screen, statistics.largest_screen)


def test_other_rows_are_refused():
    with pytest.raises(ValueError, match="view has 2 rows but the statistics have 3"):
        DensityStatistics(3).add(torch.zeros(2, 2), torch.zeros(2), 4, 4)


def watching() -> DensityStatistics:
    statistics = DensityStatistics(3, watched=("life_peaks",))
    view = (torch.zeros(3, 2), torch.tensor([1.0, 0.0, 1.0]), 4, 4)
    statistics.add(*view, {"life_peaks": torch.tensor([-2.0, 7.0, 1.0])})
    statistics.add(*view, {"life_peaks": torch.tensor([4.0, 7.0, 0.0])})
    return statistics


def test_gradients_of_a_watched_column_are_averaged_over_the_visits():
    statistics = watching()
    assert statistics.mean_gradients("life_peaks").tolist() == [3.0, 0.0, 0.5]
    assert statistics.mean_gradients().tolist() == [0.0, 0.0, 0.0]
    before = statistics.watched["life_peaks"].clone()
    statistics.add(torch.zeros(3, 2), torch.ones(3), 4, 4, {"life_peaks": torch.full((3,), torch.nan)})
    assert torch.equal(statistics.watched["life_peaks"], before)
    for _ in range(2):
        statistics.add(torch.zeros(3, 2), torch.ones(3), 4, 4, {"life_peaks": torch.full((3,), 3e38)})
    with pytest.raises(ValueError, match="gradients of life_peaks must be finite, but row 0 of 3"):
        statistics.mean_gradients("life_peaks")


def test_watched_columns_follow_the_rows_are_forgotten_and_survive_a_checkpoint():
    statistics = watching()
    resumed = DensityStatistics.from_state(statistics.state_dict())
    statistics.resize(RowPlan(3, torch.tensor([2, 0, 2]), torch.tensor([False, False, True])))
    assert statistics.mean_gradients("life_peaks").tolist() == [0.5, 3.0, 0.0]
    assert resumed.mean_gradients("life_peaks").tolist() == [3.0, 0.0, 0.5]
    resumed.reset()
    assert (resumed.visits.tolist(), resumed.largest_screen.tolist()) == ([0] * 3, [0.0] * 3)
    assert resumed.mean_gradients("life_peaks").tolist() == [0.0, 0.0, 0.0]


def test_the_first_view_may_count_for_rows_that_it_does_not_draw():
    """As in DriveStudio, after every refinement."""
    statistics = DensityStatistics(2, first_counts_all=True)
    for _ in range(2):
        statistics.reset()
        statistics.add(torch.tensor([[3.0, 0.0], [9.0, 0.0]]), torch.tensor([1.0, 0.0]), 2, 2)
        statistics.add(torch.tensor([[9.0, 0.0], [3.0, 0.0]]), torch.tensor([0.0, 1.0]), 2, 2)
        assert statistics.visits.tolist() == [1, 2]
        assert statistics.mean_gradients().tolist() == [3.0, 1.5]
    restored = DensityStatistics.from_state(statistics.state_dict())
    restored.add(torch.ones(2, 2), torch.zeros(2), 2, 2)
    assert restored.visits.tolist() == [1, 2]
