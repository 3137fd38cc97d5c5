"""KITTI's usual Python reader (pykitti, MIT licence) sees the same drive, and errs where it is known to."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.kitti import KittiReader
from sparsestreet.data.kitti.files import OWN_CAR, read_calibration
from sparsestreet.geometry.cameras import inverse
from tests.data.kitti.write import DATE, DRIVE, RECTIFIED_PLACES, write_kitti
from tests.data.plan import Plan
from tests.shared import made_once

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # those of pandas, which it imports
    pykitti = pytest.importorskip("pykitti", reason="pykitti is not installed (with --no-deps, and pandas)")

PLAN = Plan()


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "kitti", lambda folder: write_kitti(folder, PLAN))


@pytest.fixture(scope="module")
def theirs(root, tmp_path_factory):
    """It wants all four cameras: image_01 is a copy of image_00 here."""
    folder = tmp_path_factory.mktemp("pykitti")
    write_kitti(folder, PLAN)
    path = folder / DATE / "calib_cam_to_cam.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, *(line.replace("_00:", "_01:") for line in lines if "_00:" in line)]))
    return pykitti.raw(str(folder), DATE, DRIVE.rpartition("_")[2])


def test_it_has_the_same_points_and_stamps(root, theirs):
    recording = KittiReader(root=root, drive=DRIVE).recording()
    for frame in range(PLAN.num_frames):
        points = theirs.get_velo(frame)[:, :3].astype(float)
        kept = points[np.linalg.norm(points, axis=1) >= OWN_CAR]
        assert len(kept) == len(recording.sweeps[frame].read())
    # Its stamps are those of the recording computer's GPS, in microseconds; here the plan's plus 14 ms.
    first = theirs.timestamps[0]
    assert first.microsecond * 1000 == (PLAN.start + 14_000_000) % 10**9


def test_it_has_the_same_poses(root, theirs):
    """It counts from the first frame, and puts lidar and cameras on the IMU by the same two transforms."""
    reader = KittiReader(root=root, drive=DRIVE)
    poses = reader._parts().poses
    for frame, pose in poses.items():
        wanted = theirs.oxts[frame].T_w_imu.copy()
        wanted[:3, 3] += poses[0][:3, 3].numpy()
        assert np.abs(pose.numpy() - wanted).max() < 1e-7


def test_its_calibration_is_ours_but_for_the_place_of_the_cameras(root, theirs):
    """Its place of a camera is p_x / f alone. With a third number of 2.7 mm that is off by 2.7 mm cx / f along x, and
    by all of y and z."""
    ours = read_calibration(root / DATE, ["image_00", "image_02", "image_03"])
    assert np.abs(inverse(ours.imu_from_lidar).numpy() - theirs.calib.T_velo_imu).max() < 1e-12
    for name in ("image_00", "image_02", "image_03"):
        number = name[-2:]
        from_imu = inverse(ours.imu_from_camera[name]) @ ours.imu_from_lidar
        gap = getattr(theirs.calib, f"T_cam{int(number)}_velo") - from_imu.numpy()
        assert np.abs(gap[:, :3]).max() < 1e-12
        _, y, z = RECTIFIED_PLACES[number]
        matrix = PLAN.cameras[0].intrinsics
        wanted = [z * (matrix[0, 2] - 0.5) / matrix[0, 0], -y, -z]
        assert np.abs(gap[:3, 3] - wanted).max() < 1e-12
        intrinsics = getattr(theirs.calib, f"K_cam{int(number)}").copy()
        intrinsics[:2, 2] += 0.5
        assert np.abs(ours.cameras[name].intrinsics.numpy() - intrinsics).max() < 1e-12


def test_on_the_published_calibration_it_is_2_mm_off(tmp_path):
    """The line P_rect_02 of 2011_09_26: p = (44.857, 0.2164, 0.002746), f = 721.54, cx = 609.56, cy = 172.85.

    By hand: z = 2.746 mm, x = (44.857 - 609.56 z) / f = 59.85 mm, y = (0.2164 - 172.85 z) / f = -0.36 mm, where
    44.857 / f is 62.17 mm.
    """
    matrix, place = (
        np.array([[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]]),
        (44.85728, 0.2163791, 2.745884e-3),
    )
    write_kitti(tmp_path, PLAN)
    path = tmp_path / DATE / "calib_cam_to_cam.txt"
    line = "P_rect_02: " + " ".join(map(repr, np.column_stack([matrix, place]).ravel().tolist()))
    lines = [line if old.startswith("P_rect_02:") else old for old in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    found = read_calibration(tmp_path / DATE, ["image_02"]).cameras["image_02"].camera_from_rectified[:3, 3]
    assert found.tolist() == pytest.approx([0.05985, -0.000358, 0.002746], abs=1e-6)
    assert place[0] / matrix[0, 0] - float(found[0]) == pytest.approx(0.00232, abs=1e-5)
