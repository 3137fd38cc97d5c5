"""Where the time of a step goes: parts of it with names, timed only while somebody records.

Code says ``with phase("splat"):`` around what it does; without a recorder that costs a third of a microsecond. Phases
may stand in one another: time belongs to the innermost one.
"""

import time
from itertools import pairwise

import torch


class WallClock:
    """Seconds of the host."""

    def mark(self) -> float:
        return time.perf_counter()

    def seconds(self, start: float, end: float) -> float:
        return end - start


class CudaClock:
    """Seconds of the device between events of its stream, launch gaps included; waits only when asked for seconds."""

    def mark(self) -> torch.cuda.Event:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def seconds(self, start: torch.cuda.Event, end: torch.cuda.Event) -> float:
        end.synchronize()
        return 1e-3 * start.elapsed_time(end)


def clock_of(device: torch.device) -> WallClock | CudaClock:
    """The clock that sees the work of a device."""
    return CudaClock() if device.type == "cuda" else WallClock()


class PhaseRecorder:
    """What happened between ``start`` and ``stop``, as seconds by name of the phase."""

    def __init__(self, clock: WallClock | CudaClock, outside: str = "rest") -> None:
        """``outside`` is the name of the time that belongs to no phase."""
        self._clock = clock
        self._names = [outside]
        self._marks: list[tuple[object, str]] = []

    @property
    def current(self) -> str:
        """The innermost phase."""
        return self._names[-1]

    def enter(self, name: str) -> None:
        self._names.append(name)
        self._marks.append((self._clock.mark(), name))

    def leave(self) -> None:
        self._names.pop()
        self._marks.append((self._clock.mark(), self._names[-1]))

    def start(self) -> None:
        """Forget what was, and record from now on; raises RuntimeError while another recorder does."""
        global _recorder
        if _recorder not in (None, self):
            raise RuntimeError("phases are recorded by one recorder at a time: stop the other one first")
        _recorder = self
        del self._names[1:]
        self._marks = [(self._clock.mark(), self._names[0])]

    def stop(self) -> dict[str, float]:
        """Seconds of every phase since ``start``; they add up to all of it."""
        global _recorder
        _recorder = None
        marks = [*self._marks, (self._clock.mark(), "")]
        seconds: dict[str, float] = {}
        for (begin, name), (end, _) in pairwise(marks):
            seconds[name] = seconds.get(name, 0.0) + self._clock.seconds(begin, end)
        return seconds


_recorder: PhaseRecorder | None = None


class phase:  # noqa: N801 (reads as a statement)
    """``with phase(name):`` marks a part of a step for whoever records."""

    __slots__ = ("_entered", "_name")

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._entered = _recorder
        if self._entered is not None:
            self._entered.enter(self._name)

    def __exit__(self, *exception: object) -> None:
        # A recorder that was stopped meanwhile has forgotten this phase.
        if self._entered is not None and self._entered is _recorder:
            self._entered.leave()
