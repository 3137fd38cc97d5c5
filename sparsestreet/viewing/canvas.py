"""When a window is drawn anew: small pictures while something moves, one of full size once nothing does."""

from dataclasses import dataclass

from sparsestreet.viewing.pace import Pace, fitted
from sparsestreet.viewing.stage import Eye

REST = 0.2
"""Seconds without a change after which nothing moves."""
LARGEST = 1920.0 * 1200
"""Pixels of a picture at rest."""
_SHORTEST = 1 / 30
"""Seconds from one picture to the next: browsers show no more."""


@dataclass(frozen=True)
class Shot:
    """A picture that is due."""

    eye: Eye
    width: int
    height: int
    whole: bool
    """Of full size: nothing moves."""


class Canvas:
    """One window. All times are seconds of one clock."""

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.eye: Eye | None = None
        self._version = -1
        self._changed = self._drawn = float("-inf")
        self._stale, self._whole = False, False

    def look(self, eye: Eye, now: float) -> None:
        """The window's camera or size has changed."""
        self.eye, self._changed, self._stale = eye, now, True

    def due(self, version: int, now: float) -> Shot | None:
        """What to draw now, if anything; ``version`` is that of the stage."""
        if self.eye is None:
            return None
        if version != self._version:
            self._version, self._changed, self._stale = version, now, True
        width, height = self.eye.width, self.eye.height
        if self._stale and now - self._drawn >= _SHORTEST:
            return Shot(self.eye, *self.pace.size(width, height), whole=False)
        if not self._stale and not self._whole and now - self._changed >= REST:
            return Shot(self.eye, *fitted(width, height, LARGEST), whole=True)
        return None

    def drawn(self, shot: Shot, seconds: float, now: float) -> None:
        """The picture was drawn in so many seconds."""
        if not shot.whole:
            self.pace.note(seconds)
        # The camera may have moved meanwhile.
        self._drawn, self._stale, self._whole = now, self.eye is not shot.eye, shot.whole
