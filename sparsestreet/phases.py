"""Times the phases of a step and the stages of a command, only while a recorder runs.

Code marks frequent parts of a step by ``with phase("splat"):``, and rare parts of a command by
``with stage("points"):``. Without a recorder a phase costs a third of a microsecond. Both may be nested; time belongs
to the innermost one.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import torch


@runtime_checkable
class Timer(Protocol):
    """Marks moments, and says how many seconds lie between two of them."""

    def mark(self) -> Any: ...

    def seconds(self, start: Any, end: Any) -> float: ...


class WallClock:
    """Seconds of the host."""

    def mark(self) -> float:
        return time.perf_counter()

    def seconds(self, start: float, end: float) -> float:
        return end - start


class CudaClock:
    """Seconds of the device between events of its stream, launch gaps included. Only ``seconds`` waits for it."""

    def mark(self) -> torch.cuda.Event:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def seconds(self, start: torch.cuda.Event, end: torch.cuda.Event) -> float:
        end.synchronize()
        return 1e-3 * start.elapsed_time(end)


def clock_of(device: torch.device) -> Timer:
    """The clock that measures the work of a device.

    >>> clock_of(torch.device("cpu")).seconds(1.0, 3.5)
    2.5
    """
    return CudaClock() if device.type == "cuda" else WallClock()


class Timeline:
    """Adds up seconds by name; the name changes with ``enter`` and ``leave``."""

    def __init__(self, clock: Timer, outside: str = "rest") -> None:
        """``outside`` names the time outside of all other names."""
        self._clock = clock
        self._names = [outside]
        self._marks: list[tuple[object, str]] = []

    @property
    def current(self) -> str:
        """The innermost name."""
        return self._names[-1]

    def enter(self, name: str) -> None:
        self._names.append(name)
        self._marks.append((self._clock.mark(), name))

    def leave(self) -> None:
        self._names.pop()
        self._marks.append((self._clock.mark(), self._names[-1]))

    def begin(self) -> None:
        """Start anew."""
        del self._names[1:]
        self._marks = [(self._clock.mark(), self._names[0])]

    def seconds(self) -> dict[str, float]:
        """Seconds of each name since ``begin``; they add up to the whole time."""
        marks = [*self._marks, (self._clock.mark(), "")]
        seconds: defaultdict[str, float] = defaultdict(float)
        for (begin, name), (end, _) in pairwise(marks):
            seconds[name] += self._clock.seconds(begin, end)
        return dict(seconds)


class PhaseRecorder(Timeline):
    """Records the seconds of each phase between ``start`` and ``stop``."""

    def start(self) -> None:
        """Record from now on; raise RuntimeError while another recorder does."""
        global _recorder
        if _recorder not in (None, self):
            raise RuntimeError("phases are recorded by one recorder at a time: stop the other one first")
        _recorder = self
        self.begin()

    def stop(self) -> dict[str, float]:
        """Return the seconds of each phase since ``start``; they add up to the whole time."""
        global _recorder
        _recorder = None
        return self.seconds()


class StageRecorder(Timeline):
    """Records the wall clock of a command's stages inside its ``with`` block."""

    def __init__(self, since: float | None = None) -> None:
        """``since``: ``time.perf_counter`` when the command began; the time until now is the stage "start"."""
        super().__init__(WallClock(), outside="other")
        self._earlier: Counter[str] = Counter()
        self.begin()
        if since is not None:
            self._marks.insert(0, (since, "start"))

    def go_on(self, earlier: Mapping[str, float]) -> None:
        """Add what an earlier command spent on the same run."""
        self._earlier = Counter(earlier)

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage of this command and of the earlier one."""
        return dict(self._earlier + Counter(super().seconds()))

    def __enter__(self) -> "StageRecorder":
        global _stages
        _stages = self
        return self

    def __exit__(self, *exception: object) -> None:
        global _stages
        _stages = None


_stages: StageRecorder | None = None


@contextmanager
def stage(name: str) -> Iterator[None]:
    """``with stage(name):`` marks a part of a command for the recorder; names of several like parts are
    ``name/detail``.

    >>> with StageRecorder() as stages:
    ...     with stage("points"):
    ...         pass
    >>> list(stages.seconds())
    ['other', 'points']
    """
    recorder = _stages
    if recorder is None:
        yield
        return
    recorder.enter(name)
    try:
        yield
    finally:
        recorder.leave()


_recorder: PhaseRecorder | None = None


class phase:  # noqa: N801 (reads as a statement)
    """``with phase(name):`` marks a part of a step for the recorder.

    >>> recorder = PhaseRecorder(WallClock())
    >>> recorder.start()
    >>> with phase("splat"):
    ...     pass
    >>> list(recorder.stop())
    ['rest', 'splat']
    """

    __slots__ = ("_entered", "_name")

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._entered = _recorder
        if self._entered is not None:
            self._entered.enter(self._name)

    def __exit__(self, *exception: object) -> None:
        # A recorder that was stopped inside this phase has already dropped it.
        if self._entered is not None and self._entered is _recorder:
            self._entered.leave()
