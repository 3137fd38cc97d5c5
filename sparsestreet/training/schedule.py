"""When things happen: intervals that keep their shape at any length of training."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from sparsestreet.geometry.cameras import resized
from sparsestreet.types import Frame

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
        return begun and step <= self.last(course) and now > before

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


MIN_SIDE = 11
"""Pixels: SSIM's window. Images are not made smaller than this."""


@dataclass(frozen=True)
class ResolutionSchedule:
    """Sides of 1 / 2^halvings at first, which double after each ``double_in`` of the run until they are whole.

    Raises ValueError for a negative number of halvings or an interval that is not positive.

    >>> schedule = ResolutionSchedule(halvings=2, double_in=0.1)
    >>> [schedule.divisor(step, Course(100)) for step in (0, 9, 10, 20)]
    [4, 4, 2, 1]
    """

    halvings: int = 0
    """0: all images are whole."""
    double_in: float = 0.00833

    def __post_init__(self) -> None:
        if self.halvings < 0 or not self.double_in > 0:
            raise ValueError(
                f"a resolution schedule needs halvings >= 0 and double_in > 0, got {self.halvings} and {self.double_in}"
            )

    def divisor(self, step: int, course: Course) -> int:
        """Return by what the sides of the images of a step (0 is the first) are divided."""
        doubled = int(course.progress(step) / self.double_in + ROUNDING)
        return 2 ** max(self.halvings - doubled, 0)

    def of(self, frame: Frame, step: int, course: Course) -> Frame:
        """Return the frame as a step trains on it; whole, it is the same object."""
        if not self.halvings:
            return frame
        side = min(frame.camera.width, frame.camera.height)
        divisor = min(self.divisor(step, course), max(side // MIN_SIDE, 1))
        return frame if divisor == 1 else smaller(frame, divisor)


def smaller(frame: Frame, divisor: int) -> Frame:
    """Return the frame with sides of a ``divisor``-th, rounded down to whole pixels.

    Images are resized by an antialiased bicubic filter, masks take the nearest pixel, a depth is the mean of the
    returns in its part of the image.
    """
    size = (frame.camera.height // divisor, frame.camera.width // divisor)
    masks = {name: getattr(frame, name) for name in ("sky", "human", "vehicle", "ego")}
    return replace(
        frame,
        camera=resized(frame.camera, *size),
        image=_image(frame.image, size),
        depth=None if frame.depth is None else _depth(frame.depth, size),
        **{name: None if mask is None else _mask(mask, size) for name, mask in masks.items()},
    )


def _image(image: UInt8[Tensor, "h w 3"], size: tuple[int, int]) -> UInt8[Tensor, "_ _ 3"]:
    values = image.permute(2, 0, 1)[None].float()
    small = interpolate(values, size, mode="bicubic", antialias=True, align_corners=False)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).contiguous()


def _mask(mask: Bool[Tensor, "h w"], size: tuple[int, int]) -> Bool[Tensor, "_ _"]:
    return interpolate(mask[None, None].float(), size, mode="nearest")[0, 0] > 0


def _depth(depth: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "_ _"]:
    total, hits = (interpolate(each[None, None], size, mode="area")[0, 0] for each in (depth, (depth > 0).to(depth)))
    return torch.where(hits > 0, total / hits.clamp(min=1e-12), 0.0)
