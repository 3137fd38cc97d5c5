"""Matches along epipolar lines, of features that are made."""

import numpy as np
import pytest

from sparsestreet.triangulation import matches
from sparsestreet.triangulation.matches import SAME_PLACE, Features, guided_matches
from tests.triangulation.worlds import FOCAL, HEIGHT, WIDTH, cloud, descriptors, imaged, pose, rail

FIRST, SECOND = rail([0.0, 1.0])


def _features(pixels, described):
    return Features(pixels, described), (pixels - [WIDTH / 2, HEIGHT / 2]) / FOCAL


def _match(first, second, poses=(FIRST, SECOND), ratio=0.8):
    (one, one_rays), (two, two_rays) = first, second
    relative = poses[1] @ np.linalg.inv(poses[0])
    return guided_matches(one, two, one_rays, two_rays, relative, tolerance=0.8 / FOCAL, ratio=ratio).tolist()


def _worlds(count=60, poses=(FIRST, SECOND)):
    """The same points in two images, in another order in the second; and that order."""
    rng = np.random.default_rng(0)
    points, described = cloud(rng, count), descriptors(rng, count)
    order = rng.permutation(count)
    noisy = described[order] + rng.normal(size=(count, 128)).astype(np.float32) * 0.01
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    first = _features(imaged(points, poses[0])[1], described)
    return first, _features(imaged(points[order], poses[1])[1], noisy), order


@pytest.mark.parametrize(
    "second", [SECOND, pose(z=1.0), pose(x=2.0, z=-1.0, yaw=10.0)], ids=["beside", "ahead", "turned"]
)
def test_right_matches_are_found(second):
    first, second_features, order = _worlds(poses=(FIRST, second))
    expected = np.argsort(order)
    assert _match(first, second_features, (FIRST, second)) == [[row, expected[row]] for row in range(60)]


def _one(*places_and_likeness):
    """Features at places, with descriptors at a distance from that of ``_center``, each in a direction of its own."""
    described = np.zeros((len(places_and_likeness), 128), np.float32)
    for row, (_, distance) in enumerate(places_and_likeness):
        described[row, 0] = 1 - distance**2 / 2
        described[row, row + 1] = np.sqrt(1 - described[row, 0] ** 2)
    return _features(np.array([place for place, _ in places_and_likeness], float), described)


LOOKED_FOR = _one(((200.0, 100.0), 0.0))
RIGHT = ((170.0, 100.0), 0.3)
"""30 pixels of parallax at 1 m: 9 m away."""


def test_a_feature_beside_the_line_is_no_match_however_alike():
    assert _match(LOOKED_FOR, _one(((170.0, 101.0), 0.0), RIGHT)) == [[0, 1]]
    assert _match(LOOKED_FOR, _one(((170.0, 100.7), 0.0), RIGHT)) == [[0, 0]]


def test_a_feature_as_alike_elsewhere_on_the_line_leaves_it_open():
    assert _match(LOOKED_FOR, _one(RIGHT, ((150.0, 100.0), 0.36))) == []
    assert _match(LOOKED_FOR, _one(RIGHT, ((150.0, 100.0), 0.39))) == [[0, 0]]
    assert _match(LOOKED_FOR, _one(RIGHT, ((150.0, 103.0), 0.36))) == [[0, 0]]


def test_one_corner_at_several_scales_is_no_rival_of_itself():
    near, far = ((170.0 - SAME_PLACE + 0.1, 100.0), 0.31), ((170.0 - SAME_PLACE - 0.1, 100.0), 0.31)
    assert _match(LOOKED_FOR, _one(RIGHT, near)) == [[0, 0]]
    assert _match(LOOKED_FOR, _one(RIGHT, far)) == []


def test_both_must_like_each_other_best():
    two = _one(((200.0, 100.0), 0.0), ((210.0, 100.0), 0.35))
    one = _one(((170.0, 100.0), 0.0))
    assert _match(two, one) == [[0, 0]]


def test_rays_that_part_ahead_of_the_cameras_are_no_match():
    assert _match(LOOKED_FOR, _one(((230.0, 100.0), 0.0))) == []


@pytest.mark.parametrize("poses", [(FIRST, pose(z=20.0)), (pose(z=20.0), FIRST)], ids=["second", "first"])
def test_rays_that_meet_behind_one_camera_are_no_match(poses):
    """10 m ahead of one camera, and 10 m behind the other."""
    first, second = (imaged(np.array([[1.0, 0.3, 10.0]]), at)[1] for at in poses)
    described = np.eye(1, 128, dtype=np.float32)
    assert _match(_features(first, described), _features(second, described), poses) == []


@pytest.mark.parametrize(("one", "two"), [(0, 5), (5, 0), (0, 0)])
def test_images_without_features_have_no_matches(one, two):
    rng = np.random.default_rng(0)
    first, second = (_features(rng.uniform(0, 90, (count, 2)), descriptors(rng, count)) for count in (one, two))
    assert _match(first, second) == []


def test_the_size_of_the_table_does_not_matter(monkeypatch):
    first, second, _ = _worlds()
    whole = _match(first, second)
    monkeypatch.setattr(matches, "ROWS_AT_ONCE", 7)
    assert _match(first, second) == whole
    assert len(whole) == 60
