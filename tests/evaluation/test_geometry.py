"""Errors of ranges by hand, of returns that a scene answers with balls at known distances."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation import geometry
from sparsestreet.evaluation.geometry import measure_geometry, range_errors
from sparsestreet.records.geometry import Geometry, RangeErrors
from sparsestreet.records.summary import HELD_OUT, SUMMARY, TRAINING
from sparsestreet.report.result import result_lines
from sparsestreet.scene.gaussians import INTENSITIES
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Sweep, Track
from tests.evaluation.dark import evaluate, make_frames
from tests.evaluation.scenes import OPTIONS
from tests.scene.street import pose
from tests.scene.test_lidar import rows_at, scene_of

ORIGIN = torch.tensor([2.0, -1.0, 1.5], dtype=torch.float64)
AWAY = torch.tensor(
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.2], [-1.0, 0.2, 0.0], [0.0, -1.0, -0.1], [0.7, 0.7, -0.3]], dtype=torch.float64
)
RECORDED = torch.tensor([8.0, 12.0, 25.0, 50.0, 9.0], dtype=torch.float64)
DRAWN = torch.tensor([8.1, 11.5, 25.15, 53.0, math.inf], dtype=torch.float64)
"""Errors: 0.1, 0.5, 0.15 and 3 m; the last ray meets nothing."""


def points(ranges: Tensor) -> Tensor:
    return ORIGIN + ranges[:, None] * AWAY / AWAY.norm(dim=1, keepdim=True)


def sweep(index: int = 5, seen: Sequence[int] = (0, 2, 4), **changes) -> Sweep:
    colored = torch.zeros(5, dtype=torch.bool)
    colored[list(seen)] = True
    made = Sweep(index, index / 10, points(RECORDED).float(), torch.full((5, 3), 0.5), colored, origin=ORIGIN)
    return dataclasses.replace(made, **changes)


def boxes() -> tuple[Track, ...]:
    """A truck around the second return, a cyclist around the fourth, an animal around the third; all at frame 5."""
    found = []
    for row, name in ((1, "vehicle.truck"), (3, "Cyclist"), (2, "animal")):
        placed = pose(0.4, tuple(points(RECORDED)[row].tolist()))[None]
        found.append(Track(name, name, torch.tensor([5]), placed, torch.tensor([2.0, 1.0, 1.0])))
    return tuple(found)


def log_of(*sweeps: Sweep) -> DrivingLog:
    frames = make_frames(2)
    return DrivingLog("street", as_frames(frames), Sweeps.of(sweeps), boxes(), 11, 2, torch.eye(4, dtype=torch.float64))


def balls() -> SceneGraph:
    """Small and opaque ones where rays are to end."""
    met = torch.isfinite(DRAWN)
    return scene_of(rows_at(points(torch.where(met, DRAWN, 1.0))[met], (0.15, 0.15, 0.15)))


def measured(*sweeps: Sweep, held_out: frozenset[int] = frozenset({5})) -> Geometry:
    found = measure_geometry(balls(), log_of(*sweeps), held_out, OPTIONS)
    assert found is not None
    return found


def by_hand(rows: Sequence[int]) -> tuple[float, ...]:
    """Returns, met, median, mean, share within 0.2 m, chamfer: of the rays of these rows, by brute force."""
    recorded, drawn = points(RECORDED), points(DRAWN)[:4]
    met = [row for row in rows if row < 4]
    errors = [abs(float(RECORDED[row] - DRAWN[row])) for row in met]
    there = [min(float((recorded[row] - one).norm()) for one in drawn) for row in rows]
    back = [min(float((drawn[row] - one).norm()) for one in recorded) for row in met]
    within = sum(error < 0.2 for error in errors) / len(rows)
    chamfer = np.mean(there) + np.mean(back)
    return len(rows), len(met), float(np.median(errors)), float(np.mean(errors)), within, float(chamfer)


def test_errors_of_five_rays():
    found = measured(sweep())
    groups = {
        "all": (0, 1, 2, 3, 4), "vehicles": (1,), "people": (3,), "seen": (0, 2, 4), "unseen": (1, 3),
        "0-10 m": (0, 4), "10-20 m": (1,), "20-40 m": (2,), "40+ m": (3,),
    }  # fmt: skip
    assert found.groups.keys() == groups.keys()
    for name, rows in groups.items():
        assert dataclasses.astuple(found.groups[name]) == pytest.approx(by_hand(rows), abs=2e-3), name
    # In numbers: 0.1 and 0.15 of five are within 0.2 m, the median of four lies between 0.15 and 0.5.
    assert found.all.within == 0.4
    assert found.all.median == pytest.approx(0.325, abs=1e-3)
    assert (found.split, found.sweeps, found.strides) == (HELD_OUT, (5,), (1,))
    assert found == measured(sweep())  # to the last bit


def test_intensities_count_where_the_range_is_right():
    """Of the rays within 0.2 m, the first and the third: 0.6 and 0.2 were recorded, each Gaussian has 0.5."""
    scene, log = balls(), log_of(sweep())
    values = torch.tensor([0.6, 1.0, 0.2, 1.0, 1.0])
    sweeps = Sweeps(log.sweeps.indices, log.sweeps.load, load_intensities=lambda index: values)
    log = dataclasses.replace(log, sweeps=sweeps)
    without = measure_geometry(scene, log, frozenset({5}), OPTIONS)
    assert without is not None
    assert (without.intensity_error, without.intensity_spread) == (None, None)
    rows = scene.nodes["road"].rows
    rows.register_buffer(INTENSITIES, torch.full((len(rows),), 127, dtype=torch.uint8))
    found = measure_geometry(scene, log, frozenset({5}), OPTIONS)
    assert found is not None
    assert found.intensity_error == pytest.approx((0.6 - 127 / 255 + 127 / 255 - 0.2) / 2, abs=1e-6)
    assert found.intensity_spread == pytest.approx(0.2, abs=1e-6)  # around their median, 0.4
    assert found.groups == without.groups


def test_a_group_of_which_nothing_is_met_has_no_error():
    found = measured(sweep(seen=[4])).groups["seen"]
    assert dataclasses.astuple(found)[:5] == (1, 0, None, None, 0.0)
    nothing = range_errors(*np.zeros((4, 0)))
    assert nothing == RangeErrors(0, 0, None, None, None, None)
    empty = measure_geometry(scene_of(rows_at(torch.zeros(0, 3))), log_of(sweep()), frozenset({5}), OPTIONS)
    assert empty is not None
    assert empty.all == RangeErrors(5, 0, None, None, 0.0, None)


def test_sweeps_of_held_out_instants_count_and_of_training_where_none_is():
    apart = sweep(7, seen=[1])
    assert measured(sweep(), apart, held_out=frozenset({5, 9})).sweeps == (5,)
    every = measured(sweep(), apart, held_out=frozenset({9}))
    assert (every.split, every.sweeps, every.all.returns) == (TRAINING, (5, 7), 10)
    assert every.groups["seen"].returns == 4
    assert every.groups["vehicles"].returns == 1  # no box is of frame 7


def test_sweeps_and_returns_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(geometry, "MAX_RAYS", 2)
    monkeypatch.setattr(geometry, "MAX_SWEEPS", 2)
    thinned = measured(*(sweep(index, seen=[0, 3]) for index in (1, 2, 3)), held_out=frozenset({1, 2, 3}))
    assert (thinned.sweeps, thinned.strides) == ((1, 3), (3, 3))
    # The first and the fourth return of two sweeps, the two that are seen; boxes are of another frame.
    returns = {name: errors.returns for name, errors in thinned.groups.items()}
    assert returns == {"all": 4, "seen": 4, "0-10 m": 2, "40+ m": 2}


def test_returns_of_the_recording_car_are_left_out_and_the_origin_is_no_ray():
    near = points(torch.tensor([8.0, 12.0, 25.0, 0.4, 0.0], dtype=torch.float64)).float()
    found = measured(sweep(points=near))
    assert found.all.returns == 3


NO_POINTS = Sweep(5, 0.5, torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), origin=ORIGIN)


@pytest.mark.parametrize("log", [log_of(), log_of(sweep(origin=None)), log_of(NO_POINTS)])
def test_a_log_without_lidar_or_without_its_place_has_no_geometry(log):
    assert measure_geometry(balls(), log, frozenset({5}), OPTIONS) is None


@pytest.mark.lengthy
def test_a_run_with_lidar_has_the_record_and_others_do_not(tmp_path):
    held_out, training = make_frames(1, first=5), make_frames(1)
    run = tmp_path / "with"
    summary = evaluate(run, held_out, training, log=log_of(sweep(5), sweep(0)))
    found = SUMMARY.read(run).geometry
    assert found is not None
    assert (found.split, found.sweeps) == (HELD_OUT, (5,))
    assert found.all.returns == 5
    assert "geometry" not in summary.absent
    for log, reasons in ((log_of(), 0), (log_of(sweep(origin=None)), 1)):
        without = evaluate(tmp_path / "without", held_out, training, log=log)
        assert without.geometry is None
        assert ("geometry" in without.absent) == bool(reasons)
        assert not any("ranges" in line for line in result_lines(without, tmp_path))
