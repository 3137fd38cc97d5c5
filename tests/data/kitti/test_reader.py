"""A drive written as KITTI ships it is read as it was planned."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.kitti import KittiReader
from sparsestreet.data.kitti.files import point_stamps, read_stamps
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.recording import Recording
from tests.data.kitti.write import CAMERAS, DRIVE, lidar_from_camera, write_kitti
from tests.data.plan import Plan, levels, moved, pose, turned
from tests.shared import made_once

PLAN = Plan()
POSITION = 1e-7
"""Meters: 5e6 m of Mercator's plane in float64, through a tangent and a logarithm."""


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "kitti", lambda folder: write_kitti(folder, PLAN))


@pytest.fixture(scope="module")
def recording(root) -> Recording:
    return KittiReader(root=root, drive=DRIVE).recording()


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return KittiReader(root=root, drive=DRIVE).read()


@pytest.fixture(scope="module")
def shift(recording) -> np.ndarray:
    """From the plan's world to Mercator's: both have the same axes, and the first image is at the same place."""
    first = PLAN.world_from_vehicle(int(PLAN.stamps[0])) @ PLAN.cameras[0].vehicle_from_camera
    return recording.shots[0].world_from_camera[:3, 3].numpy() - first[:3, 3]


def test_the_world_is_mercators_at_the_scale_of_the_first_frame(shift):
    """By hand: 6378137 m x cos 49 x 8.4 in radians, and x ln tan(pi / 4 + 49 / 2 in radians); heights stay."""
    scale = 6378137.0 * np.cos(np.radians(49.0))
    place = np.array([scale * np.radians(8.4), scale * np.arctanh(np.sin(np.radians(49.0))), 0])
    wanted = place - [PLAN.origin[0], PLAN.origin[1], 0]
    assert np.abs(shift - wanted).max() < POSITION


def test_cameras_are_where_they_were(recording, shift):
    for shot in recording.shots:
        stamp, number = int(PLAN.stamps[shot.frame]), recording.rig[shot.camera].name[-2:]
        wanted = PLAN.world_from_vehicle(stamp) @ PLAN.vehicle_from_lidar @ lidar_from_camera(PLAN, number)
        wanted[:3, 3] += shift
        assert np.abs(shot.world_from_camera.numpy() - wanted).max() < POSITION
        assert shot.stamp == stamp
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(f, c) for f in range(4) for c in range(2)]
    assert recording.frame_stamps == tuple(PLAN.stamps.tolist())
    for camera in recording.rig:
        assert np.abs(camera.intrinsics.numpy() - PLAN.cameras[0].intrinsics).max() < 1e-5  # float32
        assert camera.distortion is None


def test_the_vehicle_is_the_imu(recording, shift):
    """It has the axes of the lidar, which lies beside it."""
    assert recording.vehicle.stamps.tolist() == PLAN.stamps.tolist()
    for stamp, found in zip(PLAN.stamps.tolist(), recording.vehicle.poses.numpy(), strict=True):
        wanted = PLAN.world_from_vehicle(stamp)
        wanted[:3, 3] += shift
        assert np.abs(found[:3, :3] - wanted[:3, :3]).max() < 1e-9
        assert np.abs(found[:3, 3] - wanted[:3, 3]).max() < 3


def test_each_point_has_its_reflectance(recording):
    for frame, sweep in recording.sweeps.items():
        np.testing.assert_allclose(sweep.intensities(), levels(len(PLAN.world_points(frame))), atol=1e-6)


def test_points_are_where_the_street_was(recording, shift):
    """20 micrometers: float32 in the file, microseconds in the plan's stamps, 32 straight parts of an arc."""
    for frame, sweep in recording.sweeps.items():
        points, wanted = sweep.read().numpy(), PLAN.world_points(frame) + shift
        assert points.shape == wanted.shape  # those of the own car are gone
        assert np.abs(points - wanted).max() < 2e-5
        still = moved(PLAN.world_from_vehicle(int(PLAN.stamps[frame])) @ PLAN.vehicle_from_lidar, PLAN.sweep(frame)[0])
        assert np.abs(still + shift - wanted).max() > 0.4  # 10 m/s for half a turn of 0.1 s
        stood = moved(PLAN.world_from_vehicle(int(PLAN.stamps[frame])) @ PLAN.vehicle_from_lidar, np.zeros((1, 3)))[0]
        assert np.abs(sweep.origin.numpy() - stood - shift).max() < POSITION
        assert sweep.stamp == PLAN.stamps[frame]


def test_the_lidar_turns_clockwise_from_behind():
    """By hand: behind on the right at the end, left after a quarter, ahead in the middle, right after three."""
    points = torch.tensor([[-1.0, 1e-9, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-9, 0]], dtype=torch.float64)
    assert point_stamps(points, 1_000, 1_400).tolist() == [1000, 1100, 1200, 1300, 1400]


def test_boxes_are_at_their_frames(recording, shift):
    car, person = recording.boxes
    assert (car.name, car.class_name, person.name, person.class_name) == ("0", "Car", "1", "Pedestrian")
    assert (car.frames.tolist(), person.frames.tolist()) == ([0, 1, 2, 3], [2, 3])
    wanted = PLAN.world_from_box(PLAN.stamps)
    wanted[:, :3, 3] += shift
    assert np.abs(car.poses - wanted).max() < POSITION
    assert car.sizes.tolist() == [list(PLAN.box_size)] * 4
    standing = PLAN.world_from_vehicle(PLAN.stamps[2:]) @ PLAN.vehicle_from_lidar @ pose(turned(1.0), (8.0, 3.0, -0.6))
    standing[:, :3, 3] += shift
    assert np.abs(person.poses - standing).max() < POSITION
    assert "1 boxes are left out, whose place nobody gave (state 0)" in recording.notes


def test_images_and_depths_agree_with_the_plan(log):
    for frame in log.frames:
        index, camera = frame.indices
        assert np.array_equal(frame.image.numpy(), PLAN.image(index, PLAN.cameras[camera]))
    assert (log.num_frames, log.num_cameras, len(log.sweeps), len(log.tracks)) == (4, 2, 4, 2)
    assert log.frame_rate == 10.0
    assert log.name == DRIVE
    assert [note.split(":")[0] for note in log.notes][:3] == ["no sky masks", "no human masks", "no vehicle masks"]
    assert log.masks == {}


def test_a_window_keeps_the_world(root, recording):
    """The scale is that of the drive's first frame, whichever are read."""
    part = KittiReader(root=root, drive=f"{DRIVE}_sync", first_frame=1, last_frame=2, cameras=["image_03"]).recording()
    assert torch.equal(part.shots[0].world_from_camera, recording.shots[3].world_from_camera)
    assert torch.equal(part.sweeps[1].read(), recording.sweeps[2].read())
    assert part.boxes[0].frames.tolist() == [0, 1]
    assert part.frame_stamps == recording.frame_stamps[1:3]


def test_gray_cameras_a_width_and_no_lidar(root):
    reader = KittiReader(root=root, drive=DRIVE, cameras=CAMERAS, width=16, lidar=False)
    log = reader.read()
    assert (log.num_cameras, len(log.sweeps)) == (3, 0)
    assert log.frames[0].image.shape == (12, 16, 3)
    assert log.frames[0].camera.intrinsics[0, 2] == pytest.approx(PLAN.cameras[0].intrinsics[0, 2] / 2)
    assert "camera image_00 records gray, not colors" in log.notes
    assert reader.check() == []


def test_a_lidar_file_that_is_missing_is_counted(tmp_path):
    """As frames 177 to 180 of drive 2011_09_26_0009: their lines in the stamps are empty."""
    folder = write_kitti(tmp_path, PLAN)
    (folder / "velodyne_points/data/0000000001.bin").unlink()
    for which in ("", "_start", "_end"):
        path = folder / f"velodyne_points/timestamps{which}.txt"
        lines = path.read_text().splitlines()
        path.write_text("\n".join([lines[0], "", *lines[2:]]) + "\n")
    log = KittiReader(root=tmp_path, drive=DRIVE).read()
    assert [len(sweep.points) for sweep in log.sweeps][1] == 0
    assert len(log.sweeps[2].points) == len(PLAN.sweep(2)[0])
    # The stamps of the images lag by the same time at all frames of the plan.
    assert [log.stamps[frame] for frame in range(4)] == PLAN.stamps.tolist()
    assert any(note.startswith("1 of 4 frames have no lidar file") for note in log.notes)
    assert any(note.startswith("1 frames without a stamp of the lidar") for note in log.notes)


def test_masks_that_somebody_made(root, tmp_path):
    folder = tmp_path / "sky" / "image_02"
    folder.mkdir(parents=True)
    for frame in range(4):
        Image.fromarray(np.full((24, 32), 255, np.uint8)).save(folder / f"{frame:010d}.png")
    log = KittiReader(root=root, drive=DRIVE, masks=tmp_path).read()
    assert log.frames[0].sky.all()
    assert log.frames[1].sky is None
    assert not any(note.startswith("no sky") for note in log.notes)
    assert log.masks == {"sky": "given"}


def test_its_hash_is_of_what_it_reads(root, tmp_path):
    reader = KittiReader(root=root, drive=DRIVE)
    folder = write_kitti(tmp_path, PLAN)
    (folder / "other.txt").write_text("")
    assert KittiReader(root=tmp_path, drive=DRIVE).data_hash() == reader.data_hash()
    (folder / "oxts/data/0000000002.txt").write_text("")
    assert KittiReader(root=tmp_path, drive=DRIVE).data_hash() != reader.data_hash()


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        # GNU date: date -u -d "2011-09-26 13:04:32" +%s
        ("2011-09-26 13:04:32.345323776", 1_317_042_272_345_323_776),
        ("2011-09-26 13:04:32", 1_317_042_272_000_000_000),
        ("2012-02-29 23:59:59.000000001", 1_330_559_999_000_000_001),
    ],
)
def test_a_line_is_the_stamp_of_its_frame(tmp_path, text, stamp):
    path = tmp_path / "timestamps.txt"
    path.write_text(f"{text}\n\n{text}\r\n")
    assert read_stamps(path) == [stamp, None, stamp]
