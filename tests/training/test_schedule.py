import math
from fractions import Fraction

import pytest

from sparsestreet.training.schedule import Interval, milestone


@pytest.mark.lengthy
def test_an_interval_keeps_its_shape_at_any_length():
    interval = Interval(start=0.1, stop=0.5, every=10)
    for steps in (1000, 30000):
        due = [step for step in range(1, steps + 1) if interval.due(step, steps)]
        assert due[0] == 0.1 * steps  # the start belongs to it
        assert due[-1] == 0.5 * steps
        assert len(due) == 0.4 * steps / 10 + 1


def test_an_interval_closes_once_even_between_two_events():
    interval = Interval(start=0.0, stop=0.81, every=100)
    closing = [step for step in range(1, 1001) if interval.closes(step, 1000)]
    assert closing == [810] == [interval.last(1000)]
    assert not interval.due(810, 1000)


@pytest.mark.parametrize("steps", [7, 60, 100, 700, 2000, 30000])
def test_steps_are_those_of_the_decimal_fraction(steps):
    """0.07 * 100 is 7.000000000000001 and 0.29 * 100 is 28.999999999999996 in floats: step 7 is in, step 29 as well."""
    for hundredths in range(101):
        exact = Fraction(hundredths, 100) * steps
        fraction = hundredths / 100
        assert milestone(fraction, steps) == max(1, math.floor(exact)), fraction
        after, before = Interval(fraction, 1.0, every=1), Interval(0.0, fraction, every=1)
        assert after.due(math.ceil(exact), steps), fraction
        assert not after.due(math.ceil(exact) - 1, steps), fraction
        assert before.last(steps) == math.floor(exact), fraction
        assert before.due(before.last(steps), steps), fraction
        assert not before.due(before.last(steps) + 1, steps), fraction


@pytest.mark.parametrize(("start", "stop", "every"), [(0.6, 0.5, 1), (-0.1, 0.5, 1), (0.0, 1.1, 1), (0.0, 1.0, 0)])
def test_impossible_intervals_are_refused(start, stop, every):
    with pytest.raises(ValueError, match="interval needs"):
        Interval(start, stop, every)


def test_a_milestone_is_a_step_of_the_run():
    assert milestone(28000 / 30000, 30000) == 28000
    assert milestone(0.0, 10) == 1
    assert milestone(1.0, 10) == 10
    for fraction in (1.5, -0.1):
        with pytest.raises(ValueError, match="fraction"):
            milestone(fraction, 10)
