"""How large a picture may be so that a camera that moves stays smooth."""

import math

_FEWEST, _MOST = 40_000.0, 1920.0 * 1080
"""Pixels of a picture while the camera moves. Below, a frame is no faster: all Gaussians are placed in any case."""
_QUICKEST = 2.0
"""Largest factor of a change between two frames; the square root of it is taken, since one frame is a noisy measure."""


class Pace:
    """Pixels of a frame, followed from how long frames take.

    >>> pace = Pace(frames_per_second=10.0)
    >>> for _ in range(30):
    ...     pace.note(seconds=pace.pixels / 5e6)  # a machine of 5 million pixels a second
    >>> round(pace.pixels / 1e5)
    5
    """

    def __init__(self, frames_per_second: float) -> None:
        self.budget = 1 / frames_per_second
        self.pixels = 200_000.0

    def note(self, seconds: float) -> None:
        """A frame of ``pixels`` took so long."""
        factor = min(max(self.budget / max(seconds, 1e-6), 1 / _QUICKEST), _QUICKEST)
        self.pixels = min(max(self.pixels * math.sqrt(factor), _FEWEST), _MOST)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of a frame of a window, in its proportions and no larger.

        >>> Pace(frames_per_second=10.0).size(1600, 800)
        (632, 316)
        """
        return fitted(width, height, self.pixels)


def fitted(width: int, height: int, pixels: float) -> tuple[int, int]:
    """Returns a size in the same proportions with at most so many pixels.

    >>> fitted(200, 100, 1e6), fitted(200, 100, 5000.0)
    ((200, 100), (100, 50))
    """
    scale = min(1.0, math.sqrt(pixels / (width * height)))
    return max(int(width * scale), 1), max(int(height * scale), 1)
