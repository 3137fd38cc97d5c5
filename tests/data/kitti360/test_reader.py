"""A sequence written as KITTI-360 ships it is read as it was planned."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.kitti360 import Kitti360Reader
from sparsestreet.data.kitti360.files import read_boxes
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.recording import Recording
from tests.data.kitti360.write import (
    LABELED,
    PARKED,
    PARKED_SIZE,
    PLAN,
    SEQUENCE,
    SIDEWAYS,
    UNPOSED,
    cuboid,
    write_fisheye,
    write_kitti360,
)
from tests.data.plan import levels, moved
from tests.shared import made_once

FRAMES = [frame for frame in range(PLAN.num_frames) if frame != UNPOSED]
POSITION = 1e-9
"""Meters: rounding of doubles at 4000 m, through a quaternion."""


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "kitti360", write_kitti360)


@pytest.fixture(scope="module")
def recording(root) -> Recording:
    return Kitti360Reader(root=root, sequence=3).recording()


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return Kitti360Reader(root=root, sequence=3).read()


def test_frames_are_those_with_poses(recording):
    assert recording.frame_stamps == tuple(PLAN.stamps[FRAMES].tolist())
    assert [shot.stem for shot in recording.shots[::2]] == [f"{frame:010d}" for frame in FRAMES]
    assert "1 frames have no pose, as the car hardly moved, and are left out" in recording.notes


def test_cameras_are_where_they_were(recording):
    for shot in recording.shots:
        stamp = int(PLAN.stamps[FRAMES[shot.frame]])
        wanted = PLAN.world_from_vehicle(stamp) @ PLAN.cameras[shot.camera].vehicle_from_camera
        assert np.abs(shot.world_from_camera.numpy() - wanted).max() < POSITION
        assert shot.stamp == stamp
    for camera, planned in zip(recording.rig, PLAN.cameras, strict=True):
        assert np.abs(camera.intrinsics.numpy() - planned.intrinsics).max() < 1e-5  # float32


def test_points_are_where_the_street_was(recording):
    """Between poses the path is straight. s behind one pose and r before the next it misses the arc by s r / 2 times
    the curvature: half a turn of 0.1 s on either side of a pose is s = r = 0.5 m, 2.5 mm, and s = 0.5 m, r = 1.5 m, 7.5
    mm, where a pose is missing or the way goes on behind the last one. Points as recorded are half a meter off."""
    curvature = PLAN.yaw_rate / PLAN.speed
    for place, sweep in recording.sweeps.items():
        points, frame = sweep.read().numpy(), FRAMES[place]
        wanted = PLAN.world_points(frame)
        alone = frame in (0, UNPOSED - 1, UNPOSED + 1, PLAN.num_frames - 1)
        bound = 0.5 * 0.5 * (1.5 if alone else 0.5) * curvature
        assert np.linalg.norm(points - wanted, axis=1).max() < bound + 2e-5
        np.testing.assert_allclose(sweep.intensities(), levels(len(wanted)), atol=1e-6)
        still = moved(PLAN.world_from_vehicle(int(PLAN.stamps[frame])) @ PLAN.vehicle_from_lidar, PLAN.sweep(frame)[0])
        assert np.abs(still - wanted).max() > 0.4
        stood = PLAN.world_from_vehicle(int(PLAN.stamps[frame])) @ PLAN.vehicle_from_lidar
        assert np.abs(sweep.origin.numpy() - stood[:3, 3]).max() < POSITION


def test_points_of_a_straight_drive_are_exact(tmp_path):
    """Where the path is straight nothing is left but float32 of the files."""
    straight = dataclasses.replace(PLAN, yaw_rate=1e-6)
    write_kitti360(tmp_path, straight)
    sweeps = Kitti360Reader(root=tmp_path, sequence="0003").recording().sweeps
    for place, sweep in sweeps.items():
        assert np.abs(sweep.read().numpy() - straight.world_points(FRAMES[place])).max() < 2e-5


def test_objects_that_move_and_that_stand(recording):
    moving, parked = recording.boxes
    assert (moving.name, moving.class_name, parked.name) == ("car-7", "car", "car-8")
    frames = [frame for frame in FRAMES if frame >= 1]
    assert [FRAMES[place] for place in moving.frames] == frames
    assert np.abs(moving.poses - PLAN.world_from_box(PLAN.stamps[frames])).max() < POSITION
    assert np.abs(moving.sizes - PLAN.box_size).max() < POSITION
    assert parked.frames.tolist() == [0, 1, 2, 3, 4]
    assert np.abs(parked.poses - PARKED).max() < POSITION
    assert np.abs(parked.sizes - PARKED_SIZE).max() < POSITION


def test_objects_that_stand_are_there_while_the_car_is_near(tmp_path):
    """A sequence of kilometers with thousands of parked cars would take gigabytes otherwise."""
    path = tmp_path / "boxes.xml"
    path.write_text(f"<opencv_storage>{cuboid(1, 13, 8, -1, PARKED, PARKED_SIZE)}</opencv_storage>")
    frames = np.array([0, 400, 401, 499, 501, 800])
    away = np.array([0.0, 149, 151, 0, 0, 0])
    positions = PARKED[:3, 3] + away[:, None] * [0, 1, 0]
    (boxes,) = read_boxes(path, frames, positions)
    # It is annotated at frames 0 to 200.
    assert frames[boxes.frames].tolist() == [0, 400, 499]
    assert read_boxes(path, frames[4:], positions[4:]) == []


def test_an_object_annotated_in_two_stretches_is_there_in_both(tmp_path):
    first = cuboid(1, 13, 8, -1, PARKED, PARKED_SIZE)
    second = cuboid(2, 13, 8, -1, PARKED, PARKED_SIZE)
    second = second.replace("<start_frame>0<", "<start_frame>600<").replace("<end_frame>200<", "<end_frame>800<")
    path = tmp_path / "boxes.xml"
    path.write_text(f"<opencv_storage>{first}{second}</opencv_storage>")
    frames = np.array([0, 700])
    (boxes,) = read_boxes(path, frames, np.repeat(PARKED[None, :3, 3], 2, 0))
    assert frames[boxes.frames].tolist() == [0, 700]


def test_labels_give_masks_on_the_images_that_have_them(log):
    first, right, *_ = log.frames
    assert first.sky[:10].all()
    assert not first.sky[10:].any()
    assert torch.equal(first.human.nonzero()[:, 1].unique(), torch.arange(24, 32))
    assert (first.vehicle.sum(), first.vehicle[20:, :8].sum()) == (32, 32)
    assert right.sky is None
    with_sky = [FRAMES[frame.frame_index] for frame in log.frames if frame.sky is not None]
    assert with_sky == list(LABELED)
    assert "3 of 10 images have labels, those of image_00: the others have no masks" in log.notes
    assert not any(note.startswith("no sky") for note in log.notes)
    assert log.masks == dict.fromkeys(("sky", "human", "vehicle"), "shipped")


def test_labels_shrink_with_the_images(root):
    frame = Kitti360Reader(root=root, sequence=3, width=16).read().frames[0]
    assert frame.image.shape == (12, 16, 3)
    assert frame.sky[:5].all()
    assert not frame.sky[5:].any()


def test_it_reads_as_a_log(log):
    assert (log.num_frames, log.num_cameras, len(log.sweeps), len(log.tracks)) == (5, 2, 5, 2)
    for frame in log.frames:
        index, camera = frame.indices
        assert np.array_equal(frame.image.numpy(), PLAN.image(FRAMES[index], PLAN.cameras[camera]))
    assert log.name == "2013_05_28_drive_0003"


def test_a_window_in_the_data_sets_own_numbers(root, recording):
    """A pose before the window and one after it keep their say in how its lidar moved."""
    reader = Kitti360Reader(root=root, sequence=SEQUENCE, first_frame=2, last_frame=4, cameras=["image_01"])
    part = reader.recording()
    assert [shot.stem for shot in part.shots] == ["0000000003", "0000000004"]
    assert torch.equal(part.sweeps[0].read(), recording.sweeps[2].read())
    assert torch.equal(part.sweeps[1].read(), recording.sweeps[3].read())
    assert reader.check() == []
    with pytest.raises(ValueError, match=r"no frame from 2 to 2 has a pose: those of .* lie between 0 and 5"):
        Kitti360Reader(root=root, sequence=3, first_frame=2, last_frame=2).read()


def test_fisheyes_are_resampled_to_pinholes(tmp_path):
    """What the fisheye shows in a direction is at the pixel that the pinhole has for it."""
    write_kitti360(tmp_path)
    write_fisheye(tmp_path)
    # The same dot as a mask that somebody made.
    images = tmp_path / "data_2d_raw" / SEQUENCE / "image_02" / "data_rgb"
    shutil.copytree(images, tmp_path / "masks" / "vehicle" / "image_02")
    cameras, masks = ["image_00", "image_02"], tmp_path / "masks"
    reader = Kitti360Reader(root=tmp_path, sequence=3, cameras=cameras, pinhole_fov=100.0, masks=masks)
    assert reader.check() == []
    log = reader.read()
    recording = reader.recording()
    for shot in recording.shots[1::2]:
        stamp = int(PLAN.stamps[FRAMES[shot.frame]])
        assert np.abs(shot.world_from_camera.numpy() - PLAN.world_from_vehicle(stamp) @ SIDEWAYS).max() < POSITION
    assert any(note.startswith("camera image_02: its lens (Mei)") for note in log.notes)
    image, camera = log.frames[1].image, log.frames[1].camera
    # The dot is 36.87 degrees right of the axis, whose tangent is 0.75.
    column = int(camera.intrinsics[0, 2] + camera.intrinsics[0, 0] * 0.75)
    row = int(camera.intrinsics[1, 2])
    assert image[row, column, 0] > 100
    assert image[:, : column - 3].max() == 0
    assert torch.equal(log.frames[1].vehicle, image[..., 0] > 0)


def test_lidar_and_boxes_that_are_not_there(tmp_path):
    """Sequence 0002 has no lidar before frame 4391; the boxes of 0004 lie in train_full."""
    write_kitti360(tmp_path)
    lidar = tmp_path / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data"
    (lidar / "0000000000.bin").unlink()
    (tmp_path / "data_3d_bboxes/train").rename(tmp_path / "data_3d_bboxes/train_full")
    log = Kitti360Reader(root=tmp_path, sequence=3).read()
    assert len(log.sweeps[0].points) == 0
    assert "1 of 5 frames have no lidar file: they have no points" in log.notes
    assert len(log.tracks) == 2
    assert len(Kitti360Reader(root=tmp_path, sequence=3, lidar=False).read().sweeps) == 0


def test_its_hash_is_of_what_it_reads(root, tmp_path):
    before = Kitti360Reader(root=root, sequence=3).data_hash()
    write_kitti360(tmp_path)
    (tmp_path / "other.txt").write_text("")
    assert Kitti360Reader(root=tmp_path, sequence=3).data_hash() == before
    path = tmp_path / "data_3d_bboxes/train" / f"{SEQUENCE}.xml"
    path.write_text(path.read_text().replace("<timestamp>5", "<timestamp>4"))
    assert Kitti360Reader(root=tmp_path, sequence=3).data_hash() != before
