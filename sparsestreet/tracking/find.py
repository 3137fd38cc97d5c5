"""Find what moves in a drive, in its lidar alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.distance import pdist

from sparsestreet.tracking.association import Chain, associate
from sparsestreet.tracking.clusters import find_clusters
from sparsestreet.tracking.drive import COUNT_MARGIN, Instant, gathered, look, moving_share
from sparsestreet.tracking.extension import extended
from sparsestreet.tracking.fit import Fit, fit
from sparsestreet.tracking.ground import Ground, find_ground
from sparsestreet.tracking.joining import join_chains
from sparsestreet.tracking.objects import FoundObject, upright_poses
from sparsestreet.tracking.path import MIN_SPEED
from sparsestreet.tracking.scans import Scan, instant_seconds, instants
from sparsestreet.tracking.settings import TrackingSettings


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
    if not scans:
        return ()
    groups = instants(scans)
    seconds = instant_seconds(groups)
    ground = find_ground(scan.points for group in groups for scan in group)
    drive = look(groups, ground, settings, report)
    clusters = [find_clusters(instant.returns.where(instant.moving), ground, settings) for instant in drive]
    chains = [chain for chain in associate(clusters, seconds, settings) if _moves(chain)]
    objects = _objects(chains, drive, seconds, ground, settings)
    frames = np.array([group[0].frame for group in groups], np.int64)
    found = [_found(one, frames) for one in _apart(objects, drive)]
    return tuple(one for one in found if one.confidence >= settings.min_confidence)


@dataclass(frozen=True)
class _Object:
    fit: Fit
    moving: float
    """Share of the returns of its core that move."""


def _objects(
    chains: Sequence[Chain],
    drive: Sequence[Instant],
    seconds: Float64[np.ndarray, " t"],
    ground: Ground,
    settings: TrackingSettings,
) -> list[_Object]:
    """Join chains to cores, and follow those that are surely objects to where they show little, or stand."""
    fitted = partial(fit, seconds=seconds, ground=ground, refine=False)
    objects = []
    for chain in join_chains(chains, fitted, seconds, settings):
        within = gathered(fitted(chain), drive)
        if len(within) < settings.min_frames:
            continue
        core = fitted(within)
        moving = moving_share(core, drive, MIN_SPEED)
        if moving > settings.min_moving_share and _is_object(core, seconds, settings, settings.min_moved):
            whole = Chain.merged((within, extended(core, drive, seconds, settings)))
            one = fit(whole, seconds, ground, refine=True)
            if _is_object(one, seconds, settings, _least_way(one, settings)):
                objects.append(_Object(one, moving))
    return objects


def _moves(chain: Chain) -> bool:
    """Whether any returns lie elsewhere than the first."""
    places = np.array([part.points[:, :2].mean(0) for part in chain.parts])
    return bool(_farthest(places) > 0.5)


def _farthest(path: Float64[np.ndarray, "n 2"]) -> float:
    """How far its places lie apart, meters: what reverses comes back to its first one."""
    return float(pdist(path).max(initial=0.0))


MAX_ERROR = 0.5
"""Meters, of the median distance between single instants and the path."""
MANY_RETURNS = 10
"""Returns a step; an object with fewer must get farther."""
MAX_PERSON = 2.4
"""Meters: people and cyclists are no higher, but leaves are."""
MIN_STRAIGHT, MIN_SEEN = 0.5, 0.4
"""Least share of its path by which an object gets away from its first place, and of its steps at which it is seen."""


def _least_way(found: Fit, settings: TrackingSettings) -> float:
    """How far an object must get, meters: what has few returns goes some way by noise alone."""
    return settings.min_moved if np.median(found.counts) >= MANY_RETURNS else settings.min_moved_few


def _is_object(found: Fit, seconds: Float64[np.ndarray, " t"], settings: TrackingSettings, least: float) -> bool:
    """Whether it goes somewhere, ``least`` meters, as leaves and the edges of what stands do not."""
    going = found.speed >= MIN_SPEED
    steps = np.linalg.norm(np.diff(found.path, axis=0), axis=1)
    walked = steps[going[1:] | going[:-1]].sum()
    moved = _farthest(found.path)
    mean_speed = walked / (seconds[found.steps[-1]] - seconds[found.steps[0]])
    goes = moved > least and moved > MIN_STRAIGHT * walked and mean_speed < settings.max_speed
    clear = found.error < MAX_ERROR and (found.counts > 0).mean() > MIN_SEEN
    if found.shape.kind != "vehicle" and found.shape.size[2] > MAX_PERSON:
        return False
    return bool(goes and clear)


MIN_COMMON, MAX_SHARED = 0.3, 0.5
"""Share of the steps of an object at which another is there too, and of its returns then, that lie in the other's box:
it is then the same thing."""


def _apart(objects: Sequence[_Object], drive: Sequence[Instant]) -> list[_Object]:
    """Keep the one with more returns of two that are at one place; those with most returns come first."""
    kept: list[_Object] = []
    for one in sorted(objects, key=lambda found: -int(found.fit.counts.sum())):
        if not any(_within(one.fit, other.fit, drive) for other in kept):
            kept.append(one)
    return kept


def _within(one: Fit, other: Fit, drive: Sequence[Instant]) -> bool:
    both = np.arange(max(one.steps[0], other.steps[0]), min(one.steps[-1], other.steps[-1]) + 1)
    if len(both) < max(1, MIN_COMMON * len(one.steps)):
        return False
    gaps = np.linalg.norm(one.path[both - one.steps[0]] - other.path[both - other.steps[0]], axis=1)
    reach = sum(float(np.linalg.norm(each.shape.size[:2] / 2 + COUNT_MARGIN)) for each in (one, other))
    if gaps.min() > reach:  # their boxes do not touch: most do not
        return False
    own = [drive[step].inside(one.at(step), COUNT_MARGIN) for step in both.tolist()]
    shared = [
        np.intersect1d(rows, drive[step].inside(other.at(step), COUNT_MARGIN))
        for step, rows in zip(both.tolist(), own, strict=True)
    ]
    return sum(map(len, shared)) > MAX_SHARED * sum(map(len, own))


def _found(one: _Object, frames: Int64[np.ndarray, " t"]) -> FoundObject:
    """The confidence is the product of the share of steps at which it is seen, of the share of its returns that move,
    and of n / (n + 2) with the median number n of returns of a step."""
    shape, counts = one.fit.shape, one.fit.counts
    median = float(np.median(counts[counts > 0]))
    return FoundObject(
        kind=shape.kind,
        frames=frames[one.fit.steps],
        world_from_object=upright_poses(
            np.column_stack((one.fit.path, one.fit.bottom + shape.size[2] / 2)), one.fit.yaw
        ),
        size=shape.size,
        size_unsure=shape.unsure,
        returns=counts,
        confidence=float((counts > 0).mean()) * one.moving * median / (median + 2),
    )
