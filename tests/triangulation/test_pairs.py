"""Which views are compared."""

from dataclasses import replace

import numpy as np
import torch

from sparsestreet.triangulation.matches import image_pairs, in_image
from tests.triangulation.worlds import INTRINSICS, pose, view


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
