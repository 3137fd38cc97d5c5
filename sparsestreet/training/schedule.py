"""When things happen: intervals that keep their shape at any length of training."""

from dataclasses import dataclass

ROUNDING = 1e-6
"""Steps by which a fraction times max_steps may lie beside the step that is meant: 0.29 * 100 is 28.999999999999996."""


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
    """Steps between two events."""
    shift: int = 0
    """Steps by which the events come after the multiples of ``every``."""

    def __post_init__(self) -> None:
        if not 0 <= self.start <= self.stop <= 1:
            raise ValueError(f"an interval needs 0 <= start <= stop <= 1, got {self.start} and {self.stop}")
        if self.every < 1:
            raise ValueError(f"an interval needs every >= 1 step, got {self.every}")
        if not 0 <= self.shift < self.every:
            raise ValueError(f"an interval needs 0 <= shift < every, got {self.shift} and {self.every}")

    def due(self, step: int, max_steps: int) -> bool:
        """Whether the event happens after ``step`` (1 is the first) of ``max_steps`` optimizer steps."""
        begun = step >= self.start * max_steps - ROUNDING
        # The first one comes a whole period after the shift.
        recurs = (step - self.shift) % self.every == 0 and (step > self.shift or self.shift == 0)
        return begun and step <= self.last(max_steps) and recurs

    def closes(self, step: int, max_steps: int) -> bool:
        """Whether ``step`` is the last one inside the interval."""
        return step == self.last(max_steps)

    def last(self, max_steps: int) -> int:
        """The last step inside the interval."""
        return last_step(self.stop, max_steps)


def last_step(fraction: float, max_steps: int) -> int:
    """The last step up to a fraction of the run, itself included."""
    return int(fraction * max_steps + ROUNDING)


def milestone(fraction: float, max_steps: int) -> int:
    """The step (at least 1) of a single event at a fraction of the run."""
    if not 0 <= fraction <= 1:
        raise ValueError(f"a milestone of the run is a fraction in [0, 1], got {fraction}")
    return max(1, last_step(fraction, max_steps))
