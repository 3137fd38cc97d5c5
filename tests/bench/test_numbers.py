"""The small formulas of the measurements: spreads and errors, against cases computed by hand."""

import pytest
import torch

from sparsestreet.bench.accuracy import GradientError, gradient_error, image_error
from sparsestreet.bench.timing import TimingBudget, spread


def test_spread_by_hand():
    value = spread([0.005, 0.001, 0.002, 0.004, 0.003])
    assert (value.median, value.minimum, value.iqr, value.repeats) == pytest.approx((3, 1, 2, 5))
    assert spread([0.25]).iqr is None


def test_budget_stops_at_repeats_and_at_time_but_not_before_the_least():
    counted: list[int] = []
    TimingBudget(repeats=4).runs(lambda: counted.append(1))
    assert len(counted) == 4
    counted.clear()
    TimingBudget(repeats=9, seconds=0.0, least=2).runs(lambda: counted.append(1))
    assert len(counted) == 2
    counted.clear()
    TimingBudget(seconds=0.0).warm_up(lambda: counted.append(1))
    assert len(counted) == 1
    TimingBudget().warm_up(lambda: counted.append(1))
    assert len(counted) == 3


def test_image_error_by_hand():
    truth = torch.zeros(1, 2, 3, dtype=torch.float64)
    image = truth.clone()
    image[0, 1, 2] = 0.6
    error = image_error(image, truth)
    assert error.maximum == 0.6
    assert error.mean == pytest.approx(0.1)
    assert error.psnr == pytest.approx(12.21849, abs=1e-5)  # mean square 0.06
    assert image_error(truth, truth).psnr is None


def test_gradient_error_by_hand():
    truth = torch.zeros(2000, 2, dtype=torch.float64)
    truth[:, 0] = 2.0
    value = truth.clone()
    value[:3] += torch.tensor([3.0, 4.0])  # rows off by 5; the root mean square of the truth's rows is 2
    error = gradient_error(value, truth)
    assert error.relative_l2 == pytest.approx((3 * 25 / (2000 * 4)) ** 0.5)
    assert error.percentile_999 == pytest.approx(2.5)  # the 1998th of 2000: the worst three begin there
    value[2] = truth[2]
    assert gradient_error(value, truth).percentile_999 == 0


def test_gradient_error_of_rows_of_numbers_and_of_blocks():
    truth = torch.tensor([3.0, 4.0], dtype=torch.float64)
    assert gradient_error(torch.tensor([3.0, 9.0], dtype=torch.float64), truth).relative_l2 == pytest.approx(1)
    blocks = torch.ones(2, 4, 3, dtype=torch.float64)
    assert gradient_error(2 * blocks, blocks).percentile_999 == pytest.approx(1)


def test_gradient_error_without_a_scale():
    nothing = torch.zeros(3, 2, dtype=torch.float64)
    assert gradient_error(nothing, nothing) == GradientError(0.0, 0.0)
    assert gradient_error(nothing + 1, nothing) == GradientError(None, None)
