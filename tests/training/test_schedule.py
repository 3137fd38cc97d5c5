import math
from fractions import Fraction

import pytest

from sparsestreet.training.schedule import Course, Interval, milestone


@pytest.mark.lengthy
def test_an_interval_keeps_its_shape_at_any_length():
    interval = Interval(start=0.1, stop=0.5, every=10)
    for steps in (1000, 30000):
        due = [step for step in range(1, steps + 1) if interval.due(step, Course(steps))]
        assert due[0] == 0.1 * steps  # the start belongs to it
        assert due[-1] == 0.5 * steps
        assert len(due) == 0.4 * steps / 10 + 1


def test_an_interval_closes_once_even_between_two_events():
    interval = Interval(start=0.0, stop=0.81, every=100)
    closing = [step for step in range(1, 1001) if interval.closes(step, Course(1000))]
    assert closing == [810] == [interval.last(Course(1000))]
    assert not interval.due(810, Course(1000))


@pytest.mark.parametrize("images", [2, 3, 8])
@pytest.mark.parametrize("shift", [0, 7])
def test_what_recurs_counts_images(images, shift):
    """It comes in the step that has the image after which it would come, if each step had one."""
    steps, interval = 200, Interval(0.0, 1.0, every=20, shift=shift)
    single = [step for step in range(1, steps * images + 1) if interval.due(step, Course(steps * images))]
    several = [step for step in range(1, steps + 1) if interval.due(step, Course(steps, images))]
    assert several == [math.ceil(step / images) for step in single]


@pytest.mark.parametrize(
    ("start", "shift", "first"), [(0.0, 0, 20), (0.0, 7, 7), (0.07, 7, 7), (0.08, 7, 27), (0.27, 7, 27)]
)
def test_the_first_comes_at_the_shift_or_where_the_interval_has_begun(start, shift, first):
    interval = Interval(start, 1.0, every=20, shift=shift)
    assert [step for step in range(1, first + 42) if interval.due(step, Course(100))] == [first, first + 20, first + 40]


@pytest.mark.parametrize("steps", [7, 60, 100, 700, 2000, 30000])
def test_steps_are_those_of_the_decimal_fraction(steps):
    """0.07 * 100 is 7.000000000000001 and 0.29 * 100 is 28.999999999999996 in floats: step 7 is in, step 29 as well."""
    for hundredths in range(101):
        exact = Fraction(hundredths, 100) * steps
        fraction = hundredths / 100
        assert milestone(fraction, Course(steps)) == max(1, math.floor(exact)), fraction
        after, before = Interval(fraction, 1.0, every=1), Interval(0.0, fraction, every=1)
        assert after.due(math.ceil(exact), Course(steps)), fraction
        assert not after.due(math.ceil(exact) - 1, Course(steps)), fraction
        assert before.last(Course(steps)) == math.floor(exact), fraction
        assert before.due(before.last(Course(steps)), Course(steps)), fraction
        assert not before.due(before.last(Course(steps)) + 1, Course(steps)), fraction


def test_impossible_moments_are_refused():
    for start, stop, every, shift in (
        (0.6, 0.5, 1, 0),
        (-0.1, 0.5, 1, 0),
        (0.0, 1.1, 1, 0),
        (0.0, 1.0, 0, 0),
        (0.0, 1.0, 3, 3),
    ):
        with pytest.raises(ValueError, match="interval needs"):
            Interval(start, stop, every, shift)
    for fraction in (1.5, -0.1):
        with pytest.raises(ValueError, match="fraction"):
            milestone(fraction, Course(10))


def test_a_course_is_even_until_it_is_changed():
    course = Course(10)
    assert [course.progress(step) for step in range(11)] == [step / 10 for step in range(11)]
    assert [course.step_at(part / 8) for part in range(9)] == [part / 8 * 10 for part in range(9)]


@pytest.mark.parametrize("steps", [(30, 80, 40), (50, 20, 90)])
def test_what_is_done_stays_done_and_nothing_is_passed_by(steps):
    course, seen = Course(60), [0.0]
    once = [fraction / 20 for fraction in range(1, 20)]
    happened = []
    step = 0
    while step < course.steps:
        step += 1
        happened += [fraction for fraction in once if milestone(fraction, course) == step]
        seen.append(course.progress(step))
        if step in (5, 11, 17):
            before = [milestone(fraction, course) for fraction in once if fraction <= seen[-1]]
            course.change(step, steps[(5, 11, 17).index(step)])
            assert course.progress(step) == pytest.approx(seen[-1], rel=1e-15)
            assert [milestone(fraction, course) for fraction in once if fraction <= seen[-1]] == before
    assert happened == once
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    # From the last change on the rest is spread evenly; the step after it is still one of the course before.
    half = (18 + course.steps) / 2
    assert course.step_at((seen[18] + 1) / 2) == pytest.approx(half)
    other = Course(1)
    other.load_state_dict(course.state_dict())
    assert [other.progress(at) for at in range(step)] == [course.progress(at) for at in range(step)]


def test_a_course_cannot_end_before_it_has_come():
    course = Course(10)
    for steps in (4, 5):
        with pytest.raises(ValueError, match=f"step 4 cannot end at step {steps}"):
            course.change(4, steps)
    course.change(4, 6)
    assert [course.progress(step) for step in (4, 5, 6)] == [0.4, 0.5, 1.0]
