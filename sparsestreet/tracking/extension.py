"""Follow an object beyond its first and its last step: where it shows little, and where it stands."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from sparsestreet.tracking.association import Chain
from sparsestreet.tracking.clusters import MAX_RETURNS
from sparsestreet.tracking.drive import MARGIN, MIN_GATHERED, Instant
from sparsestreet.tracking.fit import Box, Fit
from sparsestreet.tracking.path import HEADING_REACH
from sparsestreet.tracking.scans import Returns
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.shape import find_middles, outlines

PLACE_GAIN, VELOCITY_GAIN = 0.5, 0.25
"""Shares of the surprise at a step by which place and velocity are corrected (an alpha-beta filter)."""
MANY_RETURNS = 10
"""Returns with the full gain."""
TURNING_SPEED = 2.0
"""Meters per second, from which the heading follows the direction of motion."""


def extended(
    found: Fit, drive: Sequence[Instant], seconds: Float64[np.ndarray, " t"], settings: TrackingSettings
) -> Chain:
    """Return the returns of an object before its first and after its last step, where its place is not always taken.

    From step to step it is predicted, and what lies in the predicted box corrects it. So it slows down and stands as
    its returns do. It ends where nothing was in the box for ``max_lost`` seconds.
    """
    ahead, before = (_followed(found, drive, seconds, settings, way) for way in (1, -1))
    parts = dict(sorted((ahead | before).items()))
    return Chain(np.array(list(parts), np.int64), tuple(parts.values()))


def _followed(
    found: Fit, drive: Sequence[Instant], seconds: Float64[np.ndarray, " t"], settings: TrackingSettings, way: int
) -> dict[int, Returns]:
    row = -1 if way > 0 else 0
    step = int(found.steps[row])
    place, yaw = found.path[row], float(found.yaw[row])
    velocity = _end_velocity(found, seconds, row)
    parts: dict[int, Returns] = {}
    last = seconds[step]
    while 0 <= step + way < len(drive) and abs(seconds[step + way] - last) <= settings.max_lost:
        passed = seconds[step + way] - seconds[step]
        step, place = step + way, place + velocity * passed
        seen = _seen(drive[step], Box(place, yaw, float(found.bottom[row]), found.shape.size))
        if len(seen) < MIN_GATHERED:
            continue
        surprise = _surprise(seen, found, place, yaw)
        gain = min(1.0, len(seen) / MANY_RETURNS)
        place = place + gain * PLACE_GAIN * surprise
        velocity = velocity + gain * VELOCITY_GAIN * surprise / passed
        if np.linalg.norm(velocity) > TURNING_SPEED:
            turn = np.arctan2(velocity[1], velocity[0]) - yaw
            yaw += PLACE_GAIN * float(np.arctan2(np.sin(turn), np.cos(turn)))
        last = seconds[step]
        parts[step] = seen
    return parts


def _end_velocity(found: Fit, seconds: Float64[np.ndarray, " t"], row: int) -> Float64[np.ndarray, "2"]:
    """Mean velocity over the half second at an end, or over its first two steps where these take longer."""
    times = seconds[found.steps]
    near = np.flatnonzero(np.abs(times - times[row]) <= HEADING_REACH + 1e-6)
    other = int(near[0] if row else near[-1])
    if other == row % len(times):
        other = max(len(times) - 2, 0) if row else min(1, len(times) - 1)
    passed = times[row] - times[other]
    return (found.path[row] - found.path[other]) / passed if passed else np.zeros(2)


def _seen(instant: Instant, box: Box) -> Returns:
    rows = instant.inside(box, MARGIN)
    return instant.returns.where(rows[instant.vacated[rows]]).thinned(MAX_RETURNS)


def _surprise(seen: Returns, found: Fit, place: Float64[np.ndarray, "2"], yaw: float) -> Float64[np.ndarray, "2"]:
    """Where the returns put the middle, from where it was predicted, meters; small where they show little of it."""
    path, heading = place[None], np.array([yaw])
    outline = outlines([seen], path, heading)
    middles, weights = find_middles([seen], outline, found.shape, path, heading)
    return weights[0] * (middles[0] - place)
