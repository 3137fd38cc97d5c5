"""t intervals against scipy's own."""

import pytest
from scipy import stats

from sparsestreet.report.intervals import t_interval


def test_the_interval_is_students():
    values = [-0.2, -0.3, -0.4]
    interval = t_interval(values)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (interval.mean, interval.n) == (pytest.approx(-0.3), 3)
    assert (interval.low, interval.high) == (pytest.approx(expected.low), pytest.approx(expected.high))
    assert interval.proven


def test_what_proves_nothing():
    assert not t_interval([-1.0]).proven  # one value, however large
    assert t_interval([-1.0]).low is None
    assert not t_interval([-1.0, 0.9]).proven
    assert t_interval([]) is None
