"""Which data set's flavor a folder has: the street is the same, whichever layout tells it, or the folder is refused."""

import numpy as np
import pytest
import torch

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.problems import LogError
from tests.data.drivestudio.folders import (
    make_mounted_opencv,
    make_nuscenes,
    make_pandaset,
    make_waymo,
    pose,
    rows_of,
    write_matrix,
    write_rows,
)

AXES = "neither y (down, OpenCV) nor z (up, Waymo)"
ODD, EVEN = np.zeros((5, 3)), np.zeros((6, 3))


def assert_same_street(log, other):
    """Poses of all cameras, and points."""
    assert len(log.frames) == len(other.frames) > 0
    for one, two in zip(log.frames, other.frames, strict=True):
        torch.testing.assert_close(one.camera.camera_from_world, two.camera.camera_from_world)
    for one, two in zip(log.sweeps, other.sweeps, strict=True):
        torch.testing.assert_close(one.points, two.points)


@pytest.mark.parametrize("columns", [4, 6])
@pytest.mark.parametrize("lidar", [True, False])
def test_mounted_cameras_with_opencv_axes_are_told_by_their_mounts(columns, lidar, tmp_path):
    """They were turned on their sides in silence: by data.log.lidar=false even where the sweeps fit no row."""
    log = DriveStudioReader(make_mounted_opencv(tmp_path / "a", columns=columns), lidar=lidar).read()
    assert_same_street(log, DriveStudioReader(make_waymo(tmp_path / "b"), lidar=lidar).read())
    name = "nuplan" if lidar and columns == 6 else "kitti"
    rows = f", lidar rows of {columns} numbers" if lidar else ""
    assert log.notes[0] == f"read as data.log.flavor={name}: mounted cameras, OpenCV's axes{rows}"


def test_poses_of_images_beside_poses_of_the_vehicle_are_pandasets(tmp_path):
    log = DriveStudioReader(make_pandaset(tmp_path / "a")).read()
    assert_same_street(log, DriveStudioReader(make_nuscenes(tmp_path / "b")).read())
    assert log.notes[0] == (
        "read as data.log.flavor=pandaset: a pose for each image, OpenCV's axes, lidar rows of 5 numbers"
    )


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (make_waymo, "waymo"),
        (make_nuscenes, "nuscenes"),
        (make_mounted_opencv, "kitti"),
        (make_mounted_opencv, "argoverse"),
        (make_pandaset, "pandaset"),
    ],
)
def test_a_flavor_may_be_named(make, name, tmp_path):
    log = DriveStudioReader(make(tmp_path), flavor=name).read()
    assert_same_street(log, DriveStudioReader(tmp_path).read())
    assert not [note for note in log.notes if "data.log.flavor" in note and name in ("waymo", "nuscenes")]


@pytest.mark.parametrize(
    ("make", "name", "told"),
    [
        (make_waymo, "kitti", "waymo"),
        (make_waymo, "nuplan", "waymo"),
        (make_mounted_opencv, "waymo", "kitti, argoverse, nuplan"),
    ],
)
@pytest.mark.parametrize("lidar", [True, False])
def test_a_name_that_would_turn_all_cameras_is_refused(make, name, told, lidar, tmp_path):
    """With lidar the rows did not fit; without it the cameras lay on their sides in silence."""
    (problem,) = DriveStudioReader(make(tmp_path), flavor=name, lidar=lidar).check()
    assert f"data.log.flavor={name}, but all cameras are upright by the axes of {told}" in str(problem)


def tilt(degrees: float) -> np.ndarray:
    """Of a camera with Waymo's axes, about its axis to the left."""
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def test_tilted_cameras_are_still_told(tmp_path):
    make_waymo(tmp_path)
    write_matrix(tmp_path / "extrinsics/1.txt", pose(tilt(40.0), np.zeros(3)))
    assert not [note for note in DriveStudioReader(tmp_path).read().notes if "flavor" in note]


def test_cameras_that_leave_it_open_are_refused_until_the_flavor_is_named(tmp_path):
    """One that looks straight down has neither axis upright; nor may cameras of one vehicle differ."""
    make_waymo(tmp_path)
    write_matrix(tmp_path / "extrinsics/1.txt", pose(tilt(90.0), np.zeros(3)))
    with pytest.raises(LogError, match=r"name the flavor, data\.log\.flavor=waymo, nuscenes, kitti") as refused:
        DriveStudioReader(tmp_path).read()
    assert AXES in str(refused.value)
    assert len(DriveStudioReader(tmp_path, flavor="waymo").read().frames) == 6
    mixed = make_mounted_opencv(tmp_path / "mixed")
    write_matrix(mixed / "extrinsics/1.txt", pose(np.eye(3), np.zeros(3)))
    assert [AXES in str(problem) for problem in DriveStudioReader(mixed).check()] == [True]


@pytest.mark.parametrize(("points", "columns", "said"), [(EVEN, 4, "both"), (ODD, 7, "neither")])
def test_sweeps_that_leave_it_open_are_refused(points, columns, said, tmp_path):
    make_mounted_opencv(tmp_path)
    for frame in range(3):
        write_rows(tmp_path / f"lidar/{frame:03d}.bin", rows_of(points, columns))
    with pytest.raises(LogError, match=f"fit {said} rows of 4 .KITTI, Argoverse. and of 6 .nuPlan.") as refused:
        DriveStudioReader(tmp_path).read()
    assert "data.log.flavor=" in str(refused.value)
    assert "data.log.lidar=false" in str(refused.value)
    assert len(DriveStudioReader(tmp_path, lidar=False).read().frames) == 6
    if said == "both":
        notes = DriveStudioReader(tmp_path, flavor="argoverse").read().notes  # all of these rows are zeros
        assert any("6 of 6 in 000.bin" in note for note in notes)


def test_the_remedy_of_a_sweep_names_the_flavors_columns(tmp_path):
    make_mounted_opencv(tmp_path)
    (tmp_path / "lidar/001.bin").write_bytes(b"\0" * 20)
    (problem,) = DriveStudioReader(tmp_path, flavor="kitti").check()
    assert "20 bytes are no whole number of rows of 4 float32" in str(problem)
    assert "write float32 rows of 4 columns (kitti flavor), or name the flavor, data.log.flavor=" in str(problem)


def test_poses_of_both_kinds_are_refused(tmp_path):
    make_waymo(make_nuscenes(tmp_path))
    with pytest.raises(LogError, match="poses of images stand beside poses of the vehicle"):
        DriveStudioReader(tmp_path).read()
    assert len(DriveStudioReader(tmp_path, flavor="waymo").read().frames) == 6
