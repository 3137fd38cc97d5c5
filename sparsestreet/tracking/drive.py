"""What may be on objects at each step of a drive, and what of it lies in a box."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sparsestreet.tracking.association import Chain
from sparsestreet.tracking.clusters import MAX_RETURNS
from sparsestreet.tracking.fit import Box, Fit
from sparsestreet.tracking.free_space import count_views, packed
from sparsestreet.tracking.ground import Ground
from sparsestreet.tracking.path import in_frame
from sparsestreet.tracking.scans import Returns, Scan
from sparsestreet.tracking.settings import TrackingSettings

THIN = 0.1
"""Meters: of the returns of a scan in a cell of this side one counts, so that dense scans cost no more."""
MIN_STANDING, MAX_STANDING_FREE = 8, 0.1
"""A return stands if its place is occupied in so many scans, and at most this share of views sees through it."""
MARGIN = 0.25
"""Meters around a box within which returns belong to it."""
MIN_GATHERED = 2
"""Returns in a box from which it is seen: fewer than a cluster needs, because its place is known."""


@dataclass(frozen=True)
class Instant:
    """The returns above the road at one step."""

    returns: Returns
    moving: Bool[np.ndarray, " n"]
    """Other scans see through their places, and few find them occupied."""
    vacated: Bool[np.ndarray, " n"]
    """Other scans see through their places, however many find them occupied: what stands here is not always here."""
    standing: Bool[np.ndarray, " n"]
    """Their places are always occupied."""

    def inside(self, box: Box, margin: float) -> Int64[np.ndarray, " k"]:
        """Return the rows of the returns in a box, with a margin around and above it, meters."""
        points, half = self.returns.points, box.size[:2] / 2
        reach = float(np.hypot(*half)) + margin
        near = np.flatnonzero((np.abs(points[:, :2] - box.middle) < reach).all(1))
        within = (np.abs(in_frame(points[near], box.middle, box.yaw)) < half + margin).all(1)
        return near[within & (points[near, 2] < box.bottom + box.size[2] + margin)]


def look(
    groups: Sequence[Sequence[Scan]], ground: Ground, settings: TrackingSettings, report: Callable[[int, int], None]
) -> list[Instant]:
    """Tell what moves from what stands, at each step; a group has the scans of a step."""
    scans = [scan for group in groups for scan in group]
    candidates = [_candidates(scan, ground, settings) for scan in scans]
    occupied, free = count_views(scans, candidates, settings, report)
    drive, number = [], 0
    for group in groups:
        rows = slice(number, number + len(group))
        number += len(group)
        parts = [
            Returns(points, np.broadcast_to(scan.origin, points.shape))
            for scan, points in zip(group, candidates[rows], strict=True)
        ]
        taken, through = np.concatenate(occupied[rows]), np.concatenate(free[rows])
        share = through / np.maximum(taken + through, 1)
        vacated = through >= settings.min_free
        standing = (share < MAX_STANDING_FREE) & (taken >= MIN_STANDING)
        drive.append(Instant(Returns.joined(parts), vacated & (share > settings.min_free_share), vacated, standing))
    return drive


def _candidates(scan: Scan, ground: Ground, settings: TrackingSettings) -> Float64[np.ndarray, "k 3"]:
    """The returns of a scan above the road, one a small cell."""
    height = scan.points[:, 2] - ground.below(scan.points)
    points = scan.points[(height > settings.lowest) & (height < settings.highest)].astype(np.float64)
    return points[np.sort(np.unique(packed(points, THIN), return_index=True)[1])]


def gathered(found: Fit, drive: Sequence[Instant]) -> Chain:
    """Return all returns in the boxes of an object, but those of what surely stands."""
    steps, parts = [], []
    for step in found.steps.tolist():
        instant = drive[step]
        rows = instant.inside(found.at(step), MARGIN)
        rows = rows[~instant.standing[rows]]
        if len(rows) >= MIN_GATHERED:
            steps.append(step)
            parts.append(instant.returns.where(rows).thinned(MAX_RETURNS))
    return Chain(np.array(steps, np.int64), tuple(parts))


COUNT_MARGIN = 0.1
"""Meters around a box within which the share that moves is counted."""


def moving_share(found: Fit, drive: Sequence[Instant], speed: float) -> float:
    """Return the share of the returns in its boxes that move, at steps at which the object is at least this fast."""
    inside = moving = 0
    for step in found.steps[found.speed >= speed].tolist():
        rows = drive[step].inside(found.at(step), COUNT_MARGIN)
        inside += len(rows)
        moving += int(drive[step].moving[rows].sum())
    return moving / max(inside, 1)
