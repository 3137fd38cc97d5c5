"""The drive that layouts are written from is what it says."""

import numpy as np
import torch

from sparsestreet.data.poses import PosePath, untwisted
from tests.data.plan import PER_SECOND, Plan, moved


def test_the_car_drives_and_turns_at_its_rates():
    plan = Plan()
    now, later = plan.world_from_vehicle(plan.start + np.array([0, 1_000_000]))
    velocity = (later[:3, 3] - now[:3, 3]) / 1e-3
    assert abs(np.linalg.norm(velocity[:2]) - plan.speed) < 1e-5
    # Ahead of the car is where it drives, up the hill: to the slope's square.
    assert now[:3, 0] @ velocity / np.linalg.norm(velocity) > 0.9999
    turn = now[:3, :3].T @ later[:3, :3]
    assert abs(turn[1, 0] / 1e-3 - plan.yaw_rate) < 1e-3
    for pose in (now, later, plan.world_from_box(plan.start), *(one.vehicle_from_camera for one in plan.cameras)):
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0


def test_cameras_look_ahead_and_to_the_left_and_see_their_own_instants():
    plan = Plan()
    front, left = (one.vehicle_from_camera[:3, 2] for one in plan.cameras)
    assert front[0] > 0.99
    assert min(left[:2]) > 0.7
    first, second = (plan.world_from_camera(2, camera)[:3, 3] for camera in plan.cameras)
    assert np.linalg.norm(second - first) > 0.4  # 51 ms at 10 m/s, less the distance of the mounts


def test_returns_of_a_sweep_spread_over_a_turn_and_are_found_again_by_poses():
    plan = Plan()
    points, stamps = plan.sweep(1)
    assert np.all(stamps % 1000 == 0)
    assert np.ptp(stamps) > 0.9 * plan.period
    first = points[stamps == stamps.min()]
    assert np.all(first[:, 0] < 0)  # behind
    quarter = points[np.abs(stamps - (plan.stamps[1] - plan.period // 4)) < 2e6]
    assert np.all(quarter[:, 1] > 0)  # then left: clockwise
    times = plan.start + np.arange(-PER_SECOND // 5, PER_SECOND // 2, 1_000_000)
    path = PosePath(torch.from_numpy(times), torch.from_numpy(plan.world_from_vehicle(times)))
    found = untwisted(torch.from_numpy(moved(plan.vehicle_from_lidar, points)), torch.from_numpy(stamps), path)
    assert np.abs(found.numpy() - plan.world_points(1)).max() < 1e-5  # a chord of a millisecond for the arc


def test_images_tell_frames_and_cameras_apart():
    plan = Plan()
    images = [plan.image(frame, camera) for frame in range(plan.num_frames) for camera in plan.cameras]
    assert len({image.tobytes() for image in images}) == len(images)
    assert max(int(image.max()) for image in images) < 250
