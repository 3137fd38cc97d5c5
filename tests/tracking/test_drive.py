"""What moves, what is not always there and what stands, on drives of few places that are counted by hand."""

from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.tracking.drive import Instant, gathered, look, moving_share
from sparsestreet.tracking.extension import extended
from sparsestreet.tracking.find import _is_object
from sparsestreet.tracking.fit import Fit
from sparsestreet.tracking.free_space import count_views
from sparsestreet.tracking.ground import Ground
from sparsestreet.tracking.scans import Returns, Scan
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.tracking.shape import Shape

SETTINGS = TrackingSettings()
FLAT = Ground(np.zeros((1, 1)), np.zeros(2))
SCANS = 9
PLACES = {  # place -> number of scans that have a return there; the others see the wall behind it
    "hardly ever free": ((8.0, 0.1, 1.1), 7),
    "moves": ((8.0, 3.1, 1.1), 3),
    "waits": ((8.0, -3.1, 1.1), 6),
    "stands": ((8.0, 6.1, 1.1), 9),
    "a bridge": ((8.0, 8.1, 4.6), 3),
    "the road": ((8.0, -6.1, 0.1), 3),
}


def quiet(done: int, total: int) -> None:
    """Hear of progress."""


def wall() -> np.ndarray:
    """Returns on a wall 20 m ahead, with a ray every 0.3 degrees."""
    y, z = np.meshgrid(np.arange(-30, 30, 0.1), np.arange(-2, 12, 0.1))
    return np.column_stack((np.full(y.size, 20.0), y.ravel(), z.ravel()))


def nine_scans() -> list[list[Scan]]:
    there = [[place for place, count in PLACES.values() if number < count] for number in range(SCANS)]
    return [
        [Scan(number, 0.1 * number, np.concatenate((wall(), np.array(some))), np.array([0.0, 0.0, 1.0]))]
        for number, some in enumerate(there)
    ]


def test_what_is_seen_through_moves_or_waits_and_what_always_is_there_stands():
    first = look(nine_scans(), FLAT, SETTINGS, quiet)[0]
    seen = {}
    for name, (place, _) in PLACES.items():
        rows = np.flatnonzero(np.linalg.norm(first.returns.points - place, axis=1) < 1e-6)
        seen[name] = [(bool(first.moving[row]), bool(first.vacated[row]), bool(first.standing[row])) for row in rows]
    assert seen == {
        "hardly ever free": [(False, False, False)],  # through two scans, of three that are asked for
        "moves": [(True, True, False)],
        "waits": [(False, True, False)],  # through three of nine
        "stands": [(False, False, True)],
        "a bridge": [],
        "the road": [],
    }


def test_a_scan_with_a_return_nearby_does_not_see_through_a_place():
    """The second place lies 0.25 m beside the first, whose scan has rays to a wall behind it."""
    here, beside = np.array([[2.0, 0.01, 1.0]]), np.array([[2.0, 0.26, 1.0]])
    scans = [
        Scan(0, 0.0, np.concatenate((wall(), here)), np.array([0.0, 0.0, 1.0])),
        Scan(1, 0.1, beside, np.array([0.0, -5.0, 1.0])),
    ]
    occupied, free = count_views(scans, [here, beside], SETTINGS, quiet)
    assert [counts.tolist() for counts in occupied] == [[2], [2]]
    assert [counts.tolist() for counts in free] == [[0], [0]]
    _, free = count_views(scans, [here - (0, 0.5, 0), beside], SETTINGS, quiet)
    assert free[1].tolist() == [1]  # without it


def object_of(speed: list[float]) -> Fit:
    """Stands at the origin, 4 x 2 x 1.5 m, turned by a right angle."""
    count = len(speed)
    shape = Shape("vehicle", np.array([4.0, 2.0, 1.5]), np.full(3, 0.1))
    counts = np.full(count, 5, np.int64)
    turned = np.full(count, np.pi / 2)
    return Fit(np.arange(count), np.zeros((count, 2)), turned, np.array(speed), np.zeros(count), shape, counts, 0.0)


def instant(standing: list[bool], moving: list[bool]) -> Instant:
    """Returns in the box, one each, but for one beside it and one above it."""
    points = np.array([[0.1 * number, 1.8, 1.0] for number in range(len(standing))] + [[1.8, 0.1, 1.0], [0, 0, 2.5]])
    flags = [np.array([*some, False, False]) for some in (moving, moving, standing)]
    return Instant(Returns(points, np.zeros_like(points)), *flags)


def test_what_stands_in_the_boxes_of_an_object_is_none_of_it():
    drive = [instant([False, True, False], [True] * 3), instant([True, True, False], [True] * 3)]
    chain = gathered(object_of([5.0, 5.0]), drive)
    assert chain.steps.tolist() == [0]  # one return is too few
    assert chain.parts[0].points[:, 0] == pytest.approx([0.0, 0.2])


def test_the_share_that_moves_is_that_of_the_steps_at_which_it_goes():
    drive = [instant([False] * 4, [True, True, True, False]), instant([False] * 4, [False] * 4)]
    assert moving_share(object_of([5.0, 0.0]), drive, 0.4) == 0.75
    assert moving_share(object_of([0.0, 0.0]), drive, 0.4) == 0


def driving(path: np.ndarray, size: tuple[float, float, float] = (4.0, 2.0, 1.5)) -> Fit:
    """Heads along x at 10 m/s, with ten returns at each step of 0.1 s."""
    count = len(path)
    shape = Shape("vehicle", np.array(size), np.full(3, 0.1))
    speed, counts = np.full(count, 10.0), np.full(count, 10, np.int64)
    return Fit(np.arange(count), path, np.zeros(count), speed, np.zeros(count), shape, counts, 0.0)


@pytest.mark.parametrize("leaves", [True, False])
def test_an_object_is_followed_by_returns_that_are_not_always_there(leaves):
    """It is seen at the first three of six steps, and goes on as it went; a wall in its way is not it."""
    corners = np.array([[x, y, 1.0] for x in np.linspace(-1.9, 1.9, 6) for y in (-0.9, 0.9)])
    drive = []
    for step in range(6):
        points = corners + np.array([1.0 * step, 0.0, 0.0])
        flags = [np.full(len(points), leaves), np.full(len(points), leaves), np.full(len(points), not leaves)]
        drive.append(Instant(Returns(points, np.tile((-20.0, 0.0, 1.8), (len(points), 1))), *flags))
    path = np.column_stack((np.arange(3.0), np.zeros(3)))
    chain = extended(driving(path), drive, 0.1 * np.arange(6), SETTINGS)
    assert chain.steps.tolist() == ([3, 4, 5] if leaves else [])


def test_an_object_that_turns_is_followed_around_the_corner():
    """Straight ahead for half a second, and then around a circle of 12 m; its box turns with it."""
    corners = np.array([[x, y, 1.0] for x in np.linspace(-2.2, 2.2, 12) for y in np.linspace(-0.95, 0.95, 5)])
    drive, path = [], []
    for step in range(34):
        yaw = 0.8 * max(step - 4, 0) / 12
        path.append(np.array((0.8 * min(step, 4) + 12 * np.sin(yaw), 12 - 12 * np.cos(yaw))))
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        points = corners @ turn + np.append(path[-1], 0)
        flags = [np.ones(len(points), bool), np.ones(len(points), bool), np.zeros(len(points), bool)]
        drive.append(Instant(Returns(points, np.tile((5.0, -30.0, 1.8), (len(points), 1))), *flags))
    chain = extended(driving(np.array(path[:5]), (4.5, 2.0, 1.5)), drive, 0.1 * np.arange(34), SETTINGS)
    assert chain.steps.tolist() == list(range(5, 34))
    assert min(map(len, chain.parts)) > len(corners) / 2


def test_an_object_goes_somewhere():
    seconds = 0.1 * np.arange(9)
    along = np.column_stack((np.arange(9.0), np.zeros(9)))
    around = 2.2 * np.column_stack((np.sin(0.75 * np.arange(9.0)), np.cos(0.75 * np.arange(9.0))))
    assert _is_object(driving(along), seconds, SETTINGS, 1.0)
    assert not _is_object(driving(around), seconds, SETTINGS, 0.5)  # 0.6 m away after 13 m
    assert not _is_object(driving(along), seconds, SETTINGS, 9.0)
    assert not _is_object(driving(4 * along), seconds, SETTINGS, 1.0)  # 40 m/s
    tall = replace(driving(along), shape=Shape("pedestrian", np.array([1.0, 1.0, 2.5]), np.full(3, 0.1)))
    assert not _is_object(tall, seconds, SETTINGS, 1.0)
    assert not _is_object(replace(driving(along), error=0.6), seconds, SETTINGS, 1.0)
    rare = np.array([9, 0, 0, 9, 0, 0, 0, 0, 9])
    assert not _is_object(replace(driving(along), counts=rare), seconds, SETTINGS, 1.0)
