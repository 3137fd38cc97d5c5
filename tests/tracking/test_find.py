"""Whole drives: what is found is what moves, wherever the world's axes point and whatever is not looked at."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sparsestreet.tracking.find import find_objects
from sparsestreet.tracking.objects import FoundObject
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings
from tests.tracking.scenes import CAR, PERSON, Thing, drive, rays

SETTINGS = TrackingSettings(azimuth_bin=1.3, elevation_bin=1.1)
"""Blocks of bins hold the rays next to a place on either side."""
PASSING = Thing(CAR, lambda seconds: (-14 + 9 * seconds, 4.0, 0.0))


def found(scans: list[Scan], settings: TrackingSettings = SETTINGS) -> tuple[FoundObject, ...]:
    return find_objects(scans, settings, lambda done, total: None)


@cache
def passed() -> tuple[list[Scan], tuple[FoundObject, ...]]:
    scans = drive([PASSING])
    return scans, found(scans)


def offsets(one: FoundObject, thing: Thing, seconds: np.ndarray, slope: float = 0.0) -> np.ndarray:
    """Place and yaw of the found boxes in the true ones: x, y, z in meters, and degrees."""
    rows = []
    for pose, time in zip(one.world_from_object, seconds[one.frames], strict=True):
        relative = np.linalg.inv(thing.pose(float(time), slope)) @ pose
        rows.append([*relative[:3, 3], np.degrees(np.arctan2(relative[1, 0], relative[0, 0]))])
    return np.array(rows)


def seconds_of(scans: list[Scan]) -> np.ndarray:
    return np.array([scan.seconds for scan in scans])


def test_a_car_that_passes_is_found_where_it_is():
    scans, (car,) = passed()
    assert car.kind == "vehicle"
    assert car.frames.tolist() == list(range(car.frames[0], car.frames[-1] + 1))
    assert len(car.frames) >= 20
    # Returns are 0.1 m apart or more, and the size is a quantile of extents.
    off = np.abs(offsets(car, PASSING, seconds_of(scans)))
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.1
    assert off[:, :2].max() < 0.3
    assert off[:, 2].max() < 0.15
    assert off[:, 3].max() < 2
    assert car.size == pytest.approx(CAR, abs=0.25)
    assert car.confidence > 0.7
    above = float(np.nextafter(car.confidence, 2.0))
    assert found(scans, replace(SETTINGS, min_confidence=above)) == ()
    assert len(found(scans, replace(SETTINGS, min_confidence=car.confidence))) == 1


def test_the_world_may_be_turned_and_shifted():
    scans, (car,) = passed()
    turn = np.array([[np.cos(2.1), -np.sin(2.1), 0], [np.sin(2.1), np.cos(2.1), 0], [0, 0, 1]])
    shift = np.array([311.3, -74.9, 12.2])
    moved = [replace(s, points=s.points @ turn.T + shift, origin=turn @ s.origin + shift) for s in scans]
    (other,) = found(moved)
    assert (other.kind, other.frames.tolist()) == (car.kind, car.frames.tolist())
    # Cells lie elsewhere, so single returns are judged otherwise; it tells most at the ends.
    assert other.world_from_object[:, :3, 3] == pytest.approx(
        car.world_from_object[:, :3, 3] @ turn.T + shift, abs=0.15
    )
    assert other.world_from_object[:, :2, 0] == pytest.approx(
        car.world_from_object[:, :2, 0] @ turn[:2, :2].T, abs=0.02
    )


def test_the_order_of_scans_and_another_run_change_nothing():
    scans, (car,) = passed()
    (other,) = found(scans[::-1])
    assert (other.world_from_object == car.world_from_object).all()
    assert (other.returns == car.returns).all()


def test_two_lidars_of_a_frame_are_one_view():
    directions = rays()
    left, right = directions[directions[:, 1] > 0], directions[directions[:, 1] <= 0]
    scans = drive([PASSING], directions=left, start=(-4.0, 0.6)) + drive(
        [PASSING], directions=right, start=(-4.0, -0.6)
    )
    (car,) = found(scans)
    off = offsets(car, PASSING, seconds_of(scans[:22]))
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.1


def test_frames_that_are_not_looked_at_have_boxes_from_the_path():
    scans, _ = passed()
    blind = [replace(scan, points=np.zeros((0, 3))) if scan.frame % 4 == 2 else scan for scan in scans]
    (car,) = found(blind)
    hidden = car.frames % 4 == 2
    assert hidden.sum() >= 5
    assert (car.returns[hidden] == 0).all()
    assert (car.returns[~hidden] > 0).all()
    assert np.linalg.norm(offsets(car, PASSING, seconds_of(scans))[hidden, :2], axis=1).max() < 0.3


def test_frames_without_scans_are_left_out():
    scans, _ = passed()
    (car,) = found([scan for scan in scans if scan.frame % 4 != 2])
    assert not (car.frames % 4 == 2).any()
    off = offsets(car, PASSING, seconds_of(scans))
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.1


def test_a_road_that_climbs_carries_cars():
    scans = drive([PASSING], slope=0.12)
    (car,) = found(scans)
    off = offsets(car, PASSING, seconds_of(scans), slope=0.12)
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.15
    # The box stays upright: its ends are 0.27 m above and below the road.
    assert np.abs(off[:, 2]).max() < 0.3


def test_cars_that_cross_keep_their_names():
    across = Thing(CAR, lambda seconds: (6.0, 12.0 - 8 * seconds, -np.pi / 2))
    along = Thing(CAR, lambda seconds: (-14 + 14 * seconds, 4.0, 0.0))
    scans = drive([along, across])
    one, other = sorted(found(scans), key=lambda car: abs(car.world_from_object[0, 0, 0]))
    assert np.median(np.linalg.norm(offsets(one, across, seconds_of(scans))[:, :2], axis=1)) < 0.2
    assert np.median(np.linalg.norm(offsets(other, along, seconds_of(scans))[:, :2], axis=1)) < 0.2
    assert min(len(one.frames), len(other.frames)) >= 15


def stopping(seconds: float) -> tuple[float, float, float]:
    """8 m/s, braked at 8 m/s^2 to a stop after 1 s, and off again after 2.2 s."""
    go, stop = min(seconds, 1.0), max(seconds - 2.2, 0.0)
    return -8 + 8 * go - 4 * go**2 + 3 * stop**2, 4.5, 0.0


def test_a_car_that_stops_and_starts_is_one_and_stays_where_it_stands():
    thing = Thing(CAR, stopping)
    scans = drive([thing], frames=32)
    (car,) = found(scans)
    assert len(car.frames) >= 30
    off = offsets(car, thing, seconds_of(scans))
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.4
    assert np.abs(off[:, 3]).max() < 5
    stood = car.world_from_object[(car.frames >= 12) & (car.frames <= 20), :2, 3]
    # Which sides are seen changes while the lidar drives past.
    assert np.ptp(stood, axis=0).max() < 0.5


def pulling_out(seconds: float) -> tuple[float, float, float]:
    """Stands for 1.4 s, then leaves along a gentle curve."""
    go = max(seconds - 1.4, 0.0)
    return 6 + 3 * go**2, 6.5 - 0.6 * go**2, float(np.arctan(-0.2))


def test_a_parked_car_that_pulls_out_has_boxes_while_it_stands():
    thing = Thing(CAR, pulling_out)
    scans = drive([thing], frames=32)
    (car,) = found(scans)
    assert car.frames[0] <= 2
    assert np.linalg.norm(offsets(car, thing, seconds_of(scans))[:, :2], axis=1).max() < 0.4


def test_people_are_found_by_few_returns():
    thing = Thing(PERSON, lambda seconds: (22.0 - 1.5 * seconds, -6.0, np.pi))
    scans = drive([thing])
    (person,) = found(scans)
    assert person.kind == "pedestrian"
    assert np.median(person.returns) < 25
    # A box shows its front alone, the middle of which lies 0.3 m before its own.
    off = offsets(person, thing, seconds_of(scans))
    assert np.median(np.abs(off[:, 0])) < 0.3
    assert np.median(np.abs(off[:, 1])) < 0.1
    assert person.size[2] == pytest.approx(1.7, abs=0.15)


def test_two_frames_a_second_are_enough():
    thing = Thing(CAR, lambda seconds: (-20 + 8 * seconds, 4.0, 0.0))
    scans = drive([thing], frames=12, step=0.5, speed=1.0)
    (car,) = found(scans)
    assert np.median(np.linalg.norm(offsets(car, thing, seconds_of(scans))[:, :2], axis=1)) < 0.15


@pytest.mark.parametrize("frames", [0, 1, 2, 12])
def test_where_nothing_moves_nothing_is_found(frames):
    assert found(drive([], frames=frames)) == ()


def test_scans_without_returns_show_nothing():
    scans = [replace(scan, points=np.zeros((0, 3))) for scan in drive([], frames=4)]
    assert found(scans) == ()


def test_every_scan_is_reported():
    told = []
    find_objects(drive([], frames=3), SETTINGS, lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def turning_back(seconds: float) -> tuple[float, float, float]:
    """6 m/s for 1 s, braked at 6 m/s^2, then back at up to 3 m/s; it heads along x all the time."""
    after = max(seconds - 1.0, 0.0)
    back = max(after - 1.5, 0.0)
    return -6 + 6 * min(seconds, 1.0) + 6 * min(after, 1.5) - 3 * min(after, 1.5) ** 2 - 3 * back, 4.0, 0.0


def test_a_car_that_reverses_heads_on():
    thing = Thing(CAR, turning_back)
    scans = drive([thing], frames=45)
    (car,) = found(scans)
    off = np.abs(offsets(car, thing, seconds_of(scans)))
    assert len(car.frames) >= 40
    assert off[:, 3].max() < 10  # taken the other way it is 180
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.15


def test_returns_may_be_float32():
    scans, (car,) = passed()
    (other,) = found([replace(scan, points=scan.points.astype(np.float32)) for scan in scans])
    assert other.frames.tolist() == car.frames.tolist()
    # Rounding by 1e-6 m lets a return or two change their cells.
    assert other.world_from_object == pytest.approx(car.world_from_object, abs=0.05)
