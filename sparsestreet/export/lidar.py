"""Returns of a log's lidar as a camera sees them."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt16
from torch import Tensor

from sparsestreet.data.lazy import Sweeps
from sparsestreet.data.lidar import depth_image
from sparsestreet.types import Camera

FARTHEST = 65_535
"""Millimeters of a depth that is no smaller; 0 where there is none."""


class LidarReturns:
    """The sweeps of a log, each at its time."""

    def __init__(self, sweeps: Sweeps, times: Mapping[int, float]) -> None:
        """``times``: frame of each sweep -> normalized time."""
        self.times = times
        self._load = sweeps.load_gray
        self._read: tuple[int, Float[Tensor, "n 3"]] | None = None

    def points(self, time: float) -> Float[Tensor, "n 3"]:
        """Returns of the sweep that is nearest in time, in the world; cameras of an instant share one reading."""
        frame = min(self.times, key=lambda frame: abs(self.times[frame] - time))
        if self._read is None or self._read[0] != frame:
            self._read = frame, self._load(frame).points
        return self._read[1]

    def millimeters(self, camera: Camera, time: float) -> UInt16[np.ndarray, "h w"]:
        """Depth along the optical axis of the nearest return in each pixel; 0: none; see ``FARTHEST``.

        The lens is followed, a rolling shutter is not: all returns are where the sweep has them.
        """
        depth = depth_image(self.points(time), camera)
        millimeters = (1000 * depth).round().clamp(max=FARTHEST)
        return millimeters.numpy().astype(np.uint16)


def enlarged(values: UInt16[np.ndarray, "h w"], side: int) -> UInt16[np.ndarray, "h w"]:
    """Each value as a square of so many pixels, to the right and down; the nearer one where two of them meet."""
    found = np.where(values > 0, values.astype(np.int64), FARTHEST + 1)
    padded = np.pad(found, ((side - 1, 0), (side - 1, 0)), constant_values=FARTHEST + 1)
    height, width = found.shape
    found = np.min([padded[y : y + height, x : x + width] for y in range(side) for x in range(side)], axis=0)
    return np.where(found > FARTHEST, 0, found).astype(np.uint16)
