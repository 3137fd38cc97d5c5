import pytest

from sparsestreet.training.schedule import Interval, milestone


def test_a_window_keeps_its_shape_at_any_length():
    window = Interval(start=0.1, stop=0.5, every=10)
    for steps in (1000, 30000):
        due = [step for step in range(1, steps + 1) if window.due(step, steps)]
        assert due[0] == 0.1 * steps + 10
        assert due[-1] == 0.5 * steps
        assert len(due) == 0.4 * steps / 10


def test_a_window_closes_once_even_between_two_events():
    window = Interval(start=0.0, stop=0.81, every=100)
    closing = [step for step in range(1, 1001) if window.closes(step, 1000)]
    assert closing == [810]
    assert not window.due(810, 1000)


@pytest.mark.parametrize(("start", "stop", "every"), [(0.6, 0.5, 1), (-0.1, 0.5, 1), (0.0, 1.1, 1), (0.0, 1.0, 0)])
def test_impossible_windows_are_refused(start, stop, every):
    with pytest.raises(ValueError, match="window needs"):
        Interval(start, stop, every)


def test_a_moment_is_a_step_of_the_run():
    assert milestone(28000 / 30000, 30000) == 28000
    assert milestone(0.0, 10) == 1
    with pytest.raises(ValueError, match="fraction"):
        milestone(1.5, 10)
