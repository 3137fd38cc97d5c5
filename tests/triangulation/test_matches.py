"""Matches along epipolar lines, of features that are made."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.triangulation import matches
from sparsestreet.triangulation.matches import (
    SAME_PLACE,
    SIFT_WIDTH,
    Features,
    find_features,
    guided_matches,
    image_pairs,
    in_image,
)
from tests.triangulation.worlds import FOCAL, HEIGHT, INTRINSICS, WIDTH, cloud, descriptors, imaged, pose, rail, view

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


def _blobs(centers, width, height, sigma=2.0, aspect=1.0):
    """Bright spots on gray, round or longer along x; pixel centers at +0.5."""
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.full((height, width), 100.0)
    for column, row in centers:
        image += 110 * np.exp(-(((x - column) / aspect) ** 2 + (y - row) ** 2) / (2 * sigma**2))
    return np.repeat(image.round().clip(0, 255).astype(np.uint8)[:, :, None], 3, 2)


@pytest.mark.parametrize(("width", "bias"), [(320, 0.125), (SIFT_WIDTH, 0.25)], ids=["doubled", "as it is"])
def test_features_lie_where_the_image_shows_them(width, bias):
    """But for OpenCV's bias: a quarter of a pixel of the image that it doubles."""
    rng = np.random.default_rng(0)
    centers = np.array([(x, y) for x in range(20, 300, 25) for y in range(20, 80, 25)]) + rng.uniform(
        -0.5, 0.5, (36, 2)
    )
    pixels = find_features(_blobs(centers, width, 100), 2000).pixels
    nearest = np.linalg.norm(pixels[:, None] - centers, axis=2).argmin(0)
    off = pixels[nearest] - centers
    # Blobs are round, of 8 bits, and their scale is interpolated: a few hundredths of a pixel.
    np.testing.assert_allclose(off, bias, atol=0.05)


def test_descriptors_are_of_unit_length_and_alike_for_alike_spots():
    image = _blobs([(40, 50), (140, 50)], 200, 100)
    image[30:40, 45:50] = image[30:40, 145:150] = 255
    features = find_features(image, 2000)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    left = features.pixels[:, 0] < 90
    likeness = features.descriptors[left] @ features.descriptors[features.pixels[:, 0] > 110].T
    assert np.median(likeness.max(1)) > 0.99


def test_no_more_features_than_asked_for():
    image = np.random.default_rng(0).integers(0, 256, (96, 160, 3), np.uint8)
    assert len(find_features(image, 2000)) > 100
    assert len(find_features(image, 50)) == 50


@pytest.mark.parametrize("shape", [(96, 160, 3), (3, 5, 3), (1, 1, 3)])
def test_an_image_of_one_color_has_none(shape):
    features = find_features(np.zeros(shape, np.uint8), 2000)
    assert (features.pixels.shape, features.descriptors.shape) == ((0, 2), (0, 128))


def test_elongated_things_are_features_and_edges_are_none():
    """Curvatures of ratios 9, 20 and 36, before SIFT blurs them: with OpenCV's own limit the second is none."""
    aspects = {100: 3.0, 300: 4.5, 500: 6.0}
    spots = [_blobs([(column, 50)], SIFT_WIDTH, 100, aspect=aspect) for column, aspect in aspects.items()]
    pixels = find_features(np.maximum.reduce(spots), 2000).pixels
    found = [column for column in aspects if (np.linalg.norm(pixels - [column, 50], axis=1) < 1.5).any()]
    assert found == [100, 300]


def _pairs(*cameras):
    """Pairs of (pose, instant, camera)."""
    views = [view(*camera) for camera in cameras]
    return image_pairs(views, np.array([camera[0] for camera in cameras]).reshape(-1, 4, 4))


def test_a_car_at_8_m_s_compares_each_image_with_the_next_and_the_third():
    assert _pairs(*((pose(z=0.8 * i), i, 0) for i in range(6))) == [
        (0, 1), (0, 3), (1, 2), (1, 4), (2, 3), (2, 5), (3, 4), (4, 5),
    ]  # fmt: skip


def test_a_slow_car_waits_until_it_has_moved():
    assert _pairs(*((pose(z=0.2 * i), i, 0) for i in range(12)))[:3] == [(0, 3), (0, 10), (1, 4)]


def test_a_fast_car_compares_neighbors_once():
    assert _pairs(*((pose(z=2.5 * i), i, 0) for i in range(3))) == [(0, 1), (1, 2)]


def test_two_images_are_a_pair_and_one_is_none():
    assert _pairs((pose(), 0, 0), (pose(z=1.0), 4, 0)) == [(0, 1)]
    assert _pairs((pose(), 0, 0)) == []
    assert _pairs() == []


def test_a_camera_that_does_not_move_has_no_pairs():
    assert _pairs(*((pose(), i, 0) for i in range(5))) == []
    assert _pairs(*((pose(yaw=5.0 * i), i, camera) for i in range(5) for camera in range(2))) == []


def test_cameras_of_one_instant_are_compared_once():
    assert _pairs((pose(), 0, 0), (pose(x=0.5), 0, 1)) == [(0, 1)]


def test_cameras_in_one_place_are_compared_when_the_car_has_moved():
    """A camera to the left sees later what the one ahead of it saw."""
    drive = [(pose(z=0.8 * i, yaw=yaw), i, number) for i in range(6) for number, yaw in enumerate((0.0, -50.0))]
    across = [(first, second) for first, second in _pairs(*drive) if first % 2 != second % 2]
    # 3 m are driven in 4 steps of 0.8 m; ahead of the camera to the left is nothing that the front one sees later.
    assert across == [(0, 9), (2, 11)]


def test_cameras_back_to_back_see_nothing_in_common():
    assert _pairs((pose(), 0, 0), (pose(z=-1.0, yaw=180.0), 0, 1), (pose(z=-1.0, yaw=180.0), 9, 1)) == []


def test_a_turned_camera_is_compared_while_the_images_overlap():
    assert _pairs((pose(), 0, 0), (pose(z=1.0, yaw=40.0), 1, 0)) == [(0, 1)]
    assert _pairs((pose(), 0, 0), (pose(z=1.0, yaw=70.0), 1, 0)) == []


def test_a_point_lies_in_the_image_from_the_first_to_the_last_pixel():
    camera = view(pose(), 0).camera
    corner = np.linalg.inv(INTRINSICS.double().numpy()) @ [0, 0, 1]
    points = np.array([9 * corner * [0.999, 0.999, 1], 9 * corner * [1.001, 1, 1], [0, 0, -9], [0, 0, 0.4]])
    assert in_image(camera, pose(), points).tolist() == [True, False, False, False]
    assert in_image(camera, pose(z=-1.0), points).tolist() == [True, True, False, True]


def test_a_lens_decides_what_is_in_the_image():
    """0.7 is imaged at 0.7 (1 - 0.3 * 0.49) = 0.597, of an image that ends at 0.578; 0.65 at 0.568."""
    camera = view(pose(), 0).camera
    points = np.array([[0.7, 0, 1], [0.65, 0, 1], [0.5, 0, 1]])
    assert in_image(camera, pose(), points).tolist() == [False, False, True]
    barrel = replace(camera, distortion=torch.tensor([-0.3, 0.0, 0.0, 0.0, 0.0]))
    assert in_image(barrel, pose(), points).tolist() == [False, True, True]
