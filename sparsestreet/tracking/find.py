"""Find what moves in a drive, in its lidar alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from sparsestreet.tracking.association import Chain, associate
from sparsestreet.tracking.clusters import MAX_RETURNS, MIN_RETURNS, find_clusters
from sparsestreet.tracking.fit import Fit, fit
from sparsestreet.tracking.free_space import count_views, packed
from sparsestreet.tracking.ground import Ground, find_ground
from sparsestreet.tracking.joining import join_chains
from sparsestreet.tracking.objects import FoundObject, upright_poses
from sparsestreet.tracking.path import in_frame
from sparsestreet.tracking.scans import Returns, Scan, instant_seconds, instants
from sparsestreet.tracking.settings import TrackingSettings

THIN = 0.1
"""Meters: of the returns of a scan in a cell of this side one counts, so that dense scans cost no more."""
MIN_STANDING, MAX_STANDING_FREE = 8, 0.1
"""A return stands if its place is occupied in so many scans, and at most this share of views sees through it."""


@dataclass(frozen=True)
class Instant:
    """What may be on objects at one step of a drive."""

    returns: Returns
    moving: Bool[np.ndarray, " n"]
    """Which of them move: other scans see through their places."""
    standing: Bool[np.ndarray, " n"]
    """Which of them surely stand."""


def find_objects(
    scans: Sequence[Scan], settings: TrackingSettings, report: Callable[[int, int], None]
) -> tuple[FoundObject, ...]:
    """Return the objects that move, those with most returns first.

    What is found depends on points, origins and times alone. Scans without points stand for frames that are not looked
    at: boxes there come from those of other frames.

    Args:
        scans: of the whole drive; several of one frame have different lidars.
        settings: thresholds.
        report: called with the number of scans whose rays have been followed, and of all scans.

    Raises:
        ValueError: if time does not increase with the frames.
    """
    groups = instants(scans)
    seconds = instant_seconds(groups)
    ground = find_ground(scan.points for group in groups for scan in group)
    drive = _look(groups, ground, settings, report)
    clusters = [find_clusters(instant.returns.where(instant.moving), settings) for instant in drive]
    chains = [chain for chain in associate(clusters, seconds, settings) if _moves(chain)]
    fitted = partial(fit, seconds=seconds, ground=ground, refine=False)
    objects = []
    for chain in join_chains(chains, fitted, seconds, settings):
        if len(chain) >= settings.min_frames:
            whole = _gathered(fitted(chain), drive)
            if len(whole) >= settings.min_frames:
                objects.append(fit(whole, seconds, ground, refine=True))
    objects = [one for one in objects if _is_object(one, drive, seconds, settings)]
    frames = np.array([group[0].frame for group in groups], np.int64)
    return tuple(_found(one, frames) for one in _apart(objects))


def _look(
    groups: Sequence[Sequence[Scan]], ground: Ground, settings: TrackingSettings, report: Callable[[int, int], None]
) -> list[Instant]:
    """Tell what moves from what stands, at each step."""
    scans = [scan for group in groups for scan in group]
    candidates = [_candidates(scan, ground, settings) for scan in scans]
    occupied, free = count_views(scans, candidates, settings, report)
    drive, number = [], 0
    for group in groups:
        parts, views = [], []
        for scan in group:
            points = candidates[number]
            parts.append(Returns(points, np.broadcast_to(scan.origin, points.shape)))
            views.append(np.stack((occupied[number], free[number]), 1))
            number += 1
        taken, through = np.concatenate(views).T
        share = through / np.maximum(taken + through, 1)
        moving = (through >= settings.min_free) & (share > settings.min_free_share)
        drive.append(Instant(Returns.joined(parts), moving, (share < MAX_STANDING_FREE) & (taken >= MIN_STANDING)))
    return drive


def _candidates(scan: Scan, ground: Ground, settings: TrackingSettings) -> Float64[np.ndarray, "k 3"]:
    """Returns of a scan above the road, one a small cell."""
    height = scan.points[:, 2] - ground.below(scan.points)
    points = scan.points[(height > settings.lowest) & (height < settings.highest)]
    return points[np.sort(np.unique(packed(points, THIN), return_index=True)[1])]


def _moves(chain: Chain) -> bool:
    """Whether the last returns lie elsewhere than the first."""
    first, last = (part.points[:, :2].mean(0) for part in (chain.parts[0], chain.parts[-1]))
    return bool(np.linalg.norm(last - first) > 0.5)


GATHER_MARGIN, COUNT_MARGIN = 0.25, 0.1
"""Meters around a box within which returns belong to it; and within which the share that moves is counted."""


def _inside(returns: Returns, found: Fit, step: int, margin: float) -> Bool[np.ndarray, " n"]:
    local = in_frame(returns.points, *found.at(step))
    return (np.abs(local) < found.shape.size[:2] / 2 + margin).all(1)


def _gathered(found: Fit, drive: Sequence[Instant]) -> Chain:
    """All returns in the boxes of an object, but those of what surely stands."""
    steps, parts = [], []
    for step in found.steps.tolist():
        inside = _inside(drive[step].returns, found, step, GATHER_MARGIN) & ~drive[step].standing
        if inside.sum() >= MIN_RETURNS:
            steps.append(step)
            parts.append(drive[step].returns.where(inside).thinned(MAX_RETURNS))
    return Chain(np.array(steps, np.int64), tuple(parts))


MAX_ERROR = 0.5
"""Meters, of the median distance between single instants and the path."""
MIN_STRAIGHT, MIN_SEEN = 0.5, 0.4
"""Least share of its path by which an object gets away from its first place, and of its steps at which it is seen."""


def _is_object(
    found: Fit, drive: Sequence[Instant], seconds: Float64[np.ndarray, " t"], settings: TrackingSettings
) -> bool:
    """Whether it goes somewhere, as leaves and the edges of what stands do not."""
    walked = np.linalg.norm(np.diff(found.path, axis=0), axis=1).sum()
    moved = np.linalg.norm(found.path[-1] - found.path[0])
    least = settings.min_moved if np.median(found.counts) >= 10 else settings.min_moved_few
    mean_speed = walked / (seconds[found.steps[-1]] - seconds[found.steps[0]])
    goes = moved > least and moved > MIN_STRAIGHT * walked and mean_speed < settings.max_speed
    clear = found.error < MAX_ERROR and (found.counts > 0).mean() > MIN_SEEN
    return bool(goes and clear and _moving_share(found, drive) > settings.min_moving_share)


def _moving_share(found: Fit, drive: Sequence[Instant]) -> float:
    """Share of the returns in its boxes that move."""
    inside = [_inside(drive[step].returns, found, step, COUNT_MARGIN) for step in found.steps.tolist()]
    moving = sum(int(drive[step].moving[own].sum()) for step, own in zip(found.steps.tolist(), inside, strict=True))
    return moving / max(sum(int(own.sum()) for own in inside), 1)


MIN_COMMON, MAX_INSIDE = 0.3, 0.3
"""Share of the steps of an object at which another is there too, and of these, at which its middle lies in the other's
box: it is then the same thing."""


def _apart(objects: Sequence[Fit]) -> list[Fit]:
    """Of two that are at one place the one with more returns, those with most returns first."""
    kept: list[Fit] = []
    for one in sorted(objects, key=lambda found: -int(found.counts.sum())):
        if not any(_within(one, other) for other in kept):
            kept.append(one)
    return kept


def _within(one: Fit, other: Fit) -> bool:
    both = np.intersect1d(one.steps, other.steps).tolist()
    if len(both) < MIN_COMMON * len(one.steps):
        return False
    local = np.array([in_frame(one.at(step)[0][None], *other.at(step))[0] for step in both])
    return bool((np.abs(local) < other.shape.size[:2] / 2).all(1).mean() > MAX_INSIDE)


def _found(one: Fit, frames: np.ndarray) -> FoundObject:
    middle = np.column_stack((one.path, one.bottom + one.shape.size[2] / 2))
    seen = float((one.counts > 0).mean())
    return FoundObject(
        kind=one.shape.kind,
        frames=frames[one.steps],
        world_from_object=upright_poses(middle, one.yaw),
        size=one.shape.size,
        size_unsure=one.shape.unsure,
        returns=one.counts,
        confidence=seen,
    )
