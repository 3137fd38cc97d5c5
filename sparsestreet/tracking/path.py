"""Smooth paths through places that were measured, and the headings along them."""

from math import factorial

import numpy as np
from jaxtyping import Float64, Int64
from scipy.linalg import solveh_banded

NOMINAL_STEP = 0.1
"""Seconds: stiffness is said for logs of 10 Hz."""
ROBUST_SCALE, ROBUST_ROUNDS = 0.3, 4
"""Meters: a place this far from the path counts half. How often weights and path are computed in turn."""
ALMOST_NOTHING = 1e-9
"""Weight of steps at which nothing was measured: the path is then sought by its smoothness alone."""
BEND = 2.0
"""Weight of the penalty on accelerations. It is nothing beside measured places, but where there are none, or hardly
any, the path goes straight on."""
HEADING_REACH = 0.5
"""Seconds ahead and behind between which the direction of motion is usually taken."""
MIN_SPEED = 0.4
"""Meters per second, below which a thing stands."""


def smooth(
    steps: Int64[np.ndarray, " n"],
    places: Float64[np.ndarray, "n d"],
    weights: Float64[np.ndarray, " n"],
    seconds: Float64[np.ndarray, " t"],
    stiffness: float,
) -> Float64[np.ndarray, "s d"]:
    """Return the path at every step from the first to the last that was measured.

    It minimizes sum w |p - m|^2 + stiffness sum (jerk dt^3)^2 step / dt + BEND sum (acceleration dt^2)^2 step / dt with
    dt = 0.1 s, where the derivatives are divided differences: penalties on integrals, whatever the rate of the log.
    Places far off count less (Cauchy's weights).

    Args:
        steps: increasing; of the measured places.
        places: meters.
        weights: 1 for a place that is off by about 0.05 m.
        seconds: time of every step of the drive.
        stiffness: weight of the penalty.
    """
    first, last = int(steps[0]), int(steps[-1])
    if last == first:
        return places.copy()
    own = seconds[first : last + 1]
    bands = np.zeros((4, len(own)))
    for order, weight in ((3, stiffness), (2, BEND)):
        if order < len(own):
            bands[3 - order :] += weight * _penalty(own, order)
    at = steps - first
    robust = np.ones(len(steps))
    target = np.zeros((last - first + 1, places.shape[1]))
    for _ in range(ROBUST_ROUNDS):
        measured = bands.copy()
        measured[-1] += ALMOST_NOTHING
        measured[-1, at] += weights * robust
        target[at] = (weights * robust)[:, None] * places
        path = solveh_banded(measured, target)
        error = np.linalg.norm(path[at] - places, axis=1)
        robust = 1 / (1 + (error / ROBUST_SCALE) ** 2)
    return path


def _penalty(seconds: Float64[np.ndarray, " s"], order: int) -> Float64[np.ndarray, "b s"]:
    """Upper bands, as ``solveh_banded`` takes them, of the matrix of the penalty on divided differences."""
    count = len(seconds) - order
    table = np.stack([seconds[j : j + count] for j in range(order + 1)], 1)
    gaps = table[:, :, None] - table[:, None, :]
    gaps[:, np.arange(order + 1), np.arange(order + 1)] = 1
    span = (table[:, -1] - table[:, 0]) / order
    rows = factorial(order) * NOMINAL_STEP**order / gaps.prod(2) * np.sqrt(span / NOMINAL_STEP)[:, None]
    bands = np.zeros((order + 1, len(seconds)))
    for apart in range(order + 1):
        for j in range(order + 1 - apart):
            bands[order - apart, j + apart : j + apart + count] += rows[:, j] * rows[:, j + apart]
    return bands


def headings(
    path: Float64[np.ndarray, "s 2"],
    seconds: Float64[np.ndarray, " s"],
    min_speed: float,
    *,
    reach: float = HEADING_REACH,
    reverses: bool = False,
) -> tuple[Float64[np.ndarray, " s"], Float64[np.ndarray, " s"]]:
    """Return yaw in radians, unwrapped, and speed in meters per second at each step of a path.

    Yaw is the direction of motion, over ``reach`` seconds ahead and behind, where it is faster than ``min_speed``, or
    than half its fastest if it is always slow. Elsewhere it lies between that before and behind, since the direction of
    what stands is noise. A path of one step has yaw 0. What ``reverses`` does not turn about while it stands: where its
    direction then jumps by more than a right angle it goes backwards, and forwards is where it is fastest.
    """
    number = np.arange(len(path))
    ahead = np.searchsorted(seconds, seconds + reach + 1e-6, side="right") - 1
    behind = np.searchsorted(seconds, seconds - reach - 1e-6)
    ahead, behind = np.maximum(ahead, number + 1), np.minimum(behind, number - 1)
    ahead, behind = np.minimum(ahead, len(path) - 1), np.maximum(behind, 0)
    moved = path[ahead] - path[behind]
    speed = np.linalg.norm(moved, axis=1) / np.maximum(seconds[ahead] - seconds[behind], 1e-6)
    sure = np.flatnonzero(speed >= min(min_speed, speed.max() / 2))
    yaw = np.arctan2(moved[sure, 1], moved[sure, 0])
    if reverses:
        ways = np.cumprod(np.append(1.0, np.where(np.cos(np.diff(yaw)) < 0, -1.0, 1.0)))
        yaw += np.pi * (ways != ways[np.argmax(speed[sure])])
    return np.interp(number, sure, np.unwrap(yaw)), speed


def in_frame(
    points: Float64[np.ndarray, "n d"], middle: Float64[np.ndarray, "2"], yaw: float | np.floating
) -> Float64[np.ndarray, "n 2"]:
    """Return the plan coordinates of points in a frame that is turned by ``yaw`` about its middle."""
    offset = points[:, :2] - middle
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack((cosine * offset[:, 0] + sine * offset[:, 1], cosine * offset[:, 1] - sine * offset[:, 0]), 1)


def turned(vectors: Float64[np.ndarray, "n 2"], yaw: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
    """Return vectors of frames that are turned by ``yaw``, along the axes of the world."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y = vectors.T
    return np.stack((cosine * x - sine * y, sine * x + cosine * y), 1)
