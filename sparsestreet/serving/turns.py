"""A device that renders one picture at a time, for requests in the order in which they came."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_LOOKS = 0.05
"""Seconds after which somebody who waits looks whether the turn is still wanted."""


class Turns:
    """Gives turns in the order of asking; a lock would give them to whoever comes by."""

    def __init__(self) -> None:
        self._queue: deque[threading.Event] = deque()
        self._changing = threading.Lock()

    @contextmanager
    def turn(self, check_wanted: Callable[[], None]) -> Iterator[None]:
        """Waits, then nobody else has a turn until the block ends. ``check_wanted`` raises what ends the waiting."""
        mine = threading.Event()
        with self._changing:
            self._queue.append(mine)
            self._queue[0].set()
        try:
            while not mine.wait(_LOOKS):
                check_wanted()
            check_wanted()
            yield
        finally:
            with self._changing:
                self._queue.remove(mine)
                if self._queue:
                    self._queue[0].set()
