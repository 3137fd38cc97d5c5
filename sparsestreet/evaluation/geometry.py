"""Ranges along the rays of recorded sweeps against what these recorded: a number for geometry beside PSNR."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.data.drivestudio.annotations import role_of
from sparsestreet.data.lazy import Sweeps, spread
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.boxes import CarriedPoints
from sparsestreet.records.geometry import (
    DISTANCES,
    EVERYWHERE,
    GROUPS,
    PEOPLE,
    SEEN,
    UNSEEN,
    VEHICLES,
    WITHIN,
    Geometry,
    RangeErrors,
)
from sparsestreet.records.summary import HELD_OUT, TRAINING
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.intensities import intensities_of
from sparsestreet.scene.lidar import PIXEL, Ranges, rays_to, render_ranges
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import Sweep, Track

MAX_SWEEPS = 20
"""Measured of a log, spread over its length."""
MAX_RAYS = 20_000
"""Measured of a sweep: every second, third, ... return of one with more."""


@torch.no_grad()
def measure_geometry(
    scene: SceneGraph, log: DrivingLog, held_out: frozenset[int], options: RenderOptions
) -> Geometry | None:
    """Compare what rays meet in a scene with the returns of the log; None where it has no sweep with a known origin.

    Args:
        scene: on the device where it is rendered.
        log: whose sweeps and boxes count.
        held_out: integer frames of which nothing was trained on. If none of them has a sweep, training sweeps count.
        options: how the scene is rendered.

    Raises ValueError for a scene with numbers that are not finite.
    """
    split, sweeps = _measured(log.sweeps, held_out)
    found = {
        sweep.index: _compared(scene, sweep, sweeps.load_intensities(sweep.index), log.tracks, options)
        for sweep in sweeps.gray()
        if _is_usable(sweep)
    }
    if not found:
        return None
    recorded, drawn = np.concatenate([one.intensities for one in found.values()], 1)
    return Geometry(
        split=split,
        sweeps=tuple(found),
        strides=tuple(one.stride for one in found.values()),
        pixel=math.degrees(PIXEL),
        groups=_errors(list(found.values())),
        intensity_error=float(np.abs(drawn - recorded).mean()) if len(recorded) else None,
        intensity_spread=float(np.abs(recorded - np.median(recorded)).mean()) if len(recorded) else None,
    )


def _measured(sweeps: Sweeps, held_out: frozenset[int]) -> tuple[str, Sweeps]:
    places = [place for place, index in enumerate(sweeps.indices) if index in held_out]
    split, places = (HELD_OUT, places) if places else (TRAINING, list(range(len(sweeps))))
    return split, sweeps.at(places[at] for at in spread(len(places), MAX_SWEEPS))


def _is_usable(sweep: Sweep) -> bool:
    return sweep.origin is not None and len(sweep.points) > 0


@dataclass(frozen=True)
class _Compared:
    """Rays of a sweep, all arrays of length n."""

    stride: int
    recorded: Float64[np.ndarray, " n"]
    """Ranges, meters."""
    drawn: Float64[np.ndarray, " n"]
    """Ranges, meters; infinite where nothing is met."""
    intensities: Float64[np.ndarray, "2 k"]
    """Recorded and drawn, of rays whose range is right; none where log or scene have none."""
    to_drawn: Float64[np.ndarray, " n"]
    """Meters from the recorded point to the nearest drawn one of the sweep; infinite where there is none."""
    to_recorded: Float64[np.ndarray, " n"]
    """Meters from the drawn point to the nearest recorded one of the sweep; infinite where nothing is met."""
    groups: Mapping[str, Bool[np.ndarray, " n"]]


def _compared(
    scene: SceneGraph,
    sweep: Sweep,
    values: Float[Tensor, " n"] | None,
    tracks: Sequence[Track],
    options: RenderOptions,
) -> _Compared:
    """Draw the rays of a sweep with these intensities from its origin, with the axes of the world."""
    rows, ranges, rays = rays_to(sweep)
    stride = max(1, math.ceil(len(rows) / MAX_RAYS))
    rows, ranges, directions = rows[::stride], ranges[::stride], rays.directions[::stride]
    met = render_ranges(scene, replace(rays, directions=directions), sweep.time, options)
    drawn, directions = met.ranges.double(), directions.double()
    groups = _groups(sweep, tracks)
    return _Compared(
        stride,
        ranges.numpy(),
        drawn.numpy(),
        np.zeros((2, 0)) if values is None else _intensities(scene, met, ranges, values[rows]),
        *_nearest((ranges[:, None] * directions).numpy(), (drawn[:, None] * directions).numpy()),
        {name: members[rows].numpy() for name, members in groups.items()}
        | {name: ((ranges >= near) & (ranges < far)).numpy() for name, (near, far) in DISTANCES.items()},
    )


def _intensities(
    scene: SceneGraph, met: Ranges, ranges: Float64[Tensor, " n"], recorded: Float[Tensor, " n"]
) -> Float64[np.ndarray, "2 k"]:
    table = intensities_of(scene)
    if table is None:
        return np.zeros((2, 0))
    right = (met.ranges.double() - ranges).abs() <= WITHIN
    return torch.stack((recorded[right], table.cpu()[met.rows[right]])).double().numpy()


def _nearest(
    recorded: Float64[np.ndarray, "n 3"], drawn: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return the distance of each point to the nearest one of the other cloud; a drawn point may be infinite."""
    met = np.isfinite(drawn).all(1)
    to_drawn, to_recorded = np.full((2, len(recorded)), np.inf)
    if met.any():
        to_drawn, _ = KDTree(drawn[met]).query(recorded)
        to_recorded[met], _ = KDTree(recorded).query(drawn[met])
    return to_drawn, to_recorded


def _groups(sweep: Sweep, tracks: Sequence[Track]) -> dict[str, Bool[Tensor, " n"]]:
    """Return the groups of all returns of a sweep, but for those by distance."""
    inside = {VEHICLES: torch.zeros_like(sweep.colored), PEOPLE: torch.zeros_like(sweep.colored)}
    of_roles = {"vehicle": VEHICLES, "pedestrian": PEOPLE, "cyclist": PEOPLE}
    for track, rows, _ in CarriedPoints(sweep.points, sweep.time, sweep.index, tracks).riders:
        if group := of_roles.get(role_of(track.class_name)):
            inside[group][rows] = True
    return {EVERYWHERE: torch.ones_like(sweep.colored), **inside, SEEN: sweep.colored, UNSEEN: ~sweep.colored}


def _errors(sweeps: Sequence[_Compared]) -> dict[str, RangeErrors]:
    """Return the errors of each group that has a return."""
    columns = {
        name: np.concatenate([getattr(one, name) for one in sweeps])
        for name in ("recorded", "drawn", "to_drawn", "to_recorded")
    }
    members = {name: np.concatenate([one.groups[name] for one in sweeps]) for name in GROUPS}
    return {
        name: range_errors(**{column: values[rows] for column, values in columns.items()})
        for name, rows in members.items()
        if name == EVERYWHERE or rows.any()
    }


def range_errors(
    recorded: Float64[np.ndarray, " n"],
    drawn: Float64[np.ndarray, " n"],
    to_drawn: Float64[np.ndarray, " n"],
    to_recorded: Float64[np.ndarray, " n"],
) -> RangeErrors:
    """Return the numbers of a group of rays; what is drawn is infinite where nothing is met.

    >>> range_errors(*np.array([[2.0, 5.0], [2.1, np.inf], [0.1, 3.0], [0.1, np.inf]])).within
    0.5
    """
    met = np.isfinite(drawn)
    errors = np.abs(drawn[met] - recorded[met])
    both_ways = to_drawn.mean() + to_recorded[met].mean() if met.any() else math.inf
    return RangeErrors(
        returns=len(recorded),
        drawn=int(met.sum()),
        median=float(np.median(errors)) if met.any() else None,
        mean=float(errors.mean()) if met.any() else None,
        within=float((errors <= WITHIN).sum() / len(recorded)) if len(recorded) else None,
        chamfer=float(both_ways) if math.isfinite(both_ways) else None,
    )
