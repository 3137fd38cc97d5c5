"""When things happen: intervals that keep their shape at any length of training."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

ROUNDING = 1e-6
"""Steps by which a fraction times max_steps may lie beside the step that is meant: 0.29 * 100 is 28.999999999999996."""


class Course:
    """Which fraction of a run is done after each step.

    Evenly, unless the number of steps is changed on the way (a budget of minutes does that): what is done stays done,
    and the rest is spread over the steps that are left. No moment of the schedule is passed by or comes twice.
    """

    def __init__(self, steps: int, images_per_step: int = 1) -> None:
        self.steps = steps
        self.images_per_step = images_per_step
        """What recurs counts images, so that a schedule is as long for any number of processes."""
        self._legs = [(0, 0.0)]
        """Where each even part begins: a step, and the fraction that is done there."""

    @property
    def changed(self) -> bool:
        """Whether the run has another number of steps than it began with."""
        return len(self._legs) > 1

    def progress(self, step: int) -> float:
        """The fraction in [0, 1] that is done after ``step``."""
        first, done, last, end = self._leg(lambda leg: leg[0] <= step)
        return done + (end - done) * (step - first) / max(last - first, 1)

    def step_at(self, fraction: float) -> float:
        """Where a fraction is done; it may lie between two steps."""
        first, done, last, end = self._leg(lambda leg: leg[1] <= fraction)
        return first + (fraction - done) / (end - done) * (last - first)

    def change(self, step: int, steps: int) -> None:
        """After ``step``: the run shall end after ``steps``.

        The next step is still one of the old course: a moment between the two has happened after ``step`` already.
        Raises ValueError for a run that would have no step after the next.
        """
        first = step + 1
        if steps <= first:
            raise ValueError(f"a run that has come to step {step} cannot end at step {steps}: two steps are needed")
        self._legs = [leg for leg in self._legs if leg[0] < first] + [(first, self.progress(first))]
        self.steps = steps

    def state_dict(self) -> dict[str, Any]:
        return {"steps": self.steps, "legs": self._legs}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.steps, self._legs = state["steps"], [tuple(leg) for leg in state["legs"]]

    def _leg(self, begun: Callable[[tuple[int, float]], bool]) -> tuple[int, float, int, float]:
        """The first and last step of the last leg that has begun, and what is done there."""
        index = max(sum(begun(leg) for leg in self._legs) - 1, 0)
        ends = [*self._legs[1:], (self.steps, 1.0)]
        (first, done), (last, end) = self._legs[index], ends[index]
        return first, done, last, end


@dataclass(frozen=True)
class Interval:
    """A recurring event between two fractions of the run.

    Fractions rather than steps, so that a run of 2,000 steps has the shape of one of 30,000; only ``every`` counts
    steps, since statistics need a number of images whatever the length of the run.
    """

    start: float
    """Fraction of max_steps at which the event may happen first."""
    stop: float
    """Fraction of max_steps at which it happens last."""
    every: int = 100
    """Steps of one image between two events; with n images a step they are n times as near."""
    shift: int = 0
    """Steps of one image by which the events come after the multiples of ``every``."""

    def __post_init__(self) -> None:
        if not 0 <= self.start <= self.stop <= 1:
            raise ValueError(f"an interval needs 0 <= start <= stop <= 1, got {self.start} and {self.stop}")
        if self.every < 1:
            raise ValueError(f"an interval needs every >= 1 step, got {self.every}")
        if not 0 <= self.shift < self.every:
            raise ValueError(f"an interval needs 0 <= shift < every, got {self.shift} and {self.every}")

    def due(self, step: int, course: Course) -> bool:
        """Whether the event happens after ``step`` (1 is the first)."""
        begun = step >= course.step_at(self.start) - ROUNDING
        before, now = (((step - back) * course.images_per_step - self.shift) // self.every for back in (1, 0))
        # The first one comes a whole period after the shift.
        recurs = now > before and (now > 0 or self.shift == 0)
        return begun and step <= self.last(course) and recurs

    def closes(self, step: int, course: Course) -> bool:
        """Whether ``step`` is the last one inside the interval."""
        return step == self.last(course)

    def last(self, course: Course) -> int:
        """The last step inside the interval."""
        return last_step(self.stop, course)


def last_step(fraction: float, course: Course) -> int:
    """The last step up to a fraction of the run, itself included."""
    return int(course.step_at(fraction) + ROUNDING)


def milestone(fraction: float, course: Course) -> int:
    """The step (at least 1) of a single event at a fraction of the run."""
    if not 0 <= fraction <= 1:
        raise ValueError(f"a milestone of the run is a fraction in [0, 1], got {fraction}")
    return max(1, last_step(fraction, course))
