"""Genuine files of KITTI's raw data: geometry that the files do not tell, settled by pixels and points."""

import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.kitti import KittiReader
from sparsestreet.data.kitti.files import point_stamps, read_calibration, read_points
from sparsestreet.data.kitti.reader import Tracklet, read_oxts, read_tracklets
from sparsestreet.data.poses import untwisted
from sparsestreet.data.recording import Recording
from sparsestreet.geometry.cameras import inverse, transform_points
from tests.data.kitti.write import DATE, DRIVE, RECTIFIED_PLACES, write_kitti
from tests.data.plan import Plan

SAMPLE = "2011_09_26_drive_0005"


def _sample(name: str) -> Path:
    default = Path(__file__).resolve().parents[4] / "shared" / "data"
    root = Path(os.environ.get("SPARSESTREET_DATA", default)) / name
    if not root.is_dir():
        pytest.skip(f"no recorded data at {root}: set SPARSESTREET_DATA to the folder that holds {name}")
    return root


@pytest.fixture(scope="module")
def raw() -> Path:
    return _sample("kitti_raw_0005")


@pytest.fixture(scope="module")
def recording(raw) -> Recording:
    return KittiReader(root=raw, drive=SAMPLE).recording()


@pytest.fixture(scope="module")
def tracklets() -> list[Tracklet]:
    return read_tracklets(_sample("kitti_raw_0001_tracklets") / "tracklet_labels.xml")


def test_a_drive_of_one_frame_is_read(raw, recording):
    """Its stamps are those of all 154 frames, of which one is there."""
    assert [camera.size for camera in recording.rig] == [(1242, 375)] * 2
    assert recording.frame_stamps == (1317042272335337762,)  # 2011-09-26 13:04:32 as if it were UTC
    assert recording.boxes is None
    assert KittiReader(root=raw, drive=SAMPLE, cameras=["image_00", "image_03"]).check() == []
    points = recording.sweeps[0].read()
    assert len(points) == 123_397 - 34  # those nearer than 2.5 m are of the car itself


def _edges(points: Float64[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """The nearer of two returns in a row of a laser whose ranges differ by more than a meter."""
    ranges = points.norm(dim=-1)
    step, turn = ranges.diff(), torch.atan2(points[:, 1], points[:, 0]).diff().abs() < 0.01
    edges = torch.zeros(len(points), dtype=torch.bool)
    edges[:-1] |= turn & (step > 1)
    edges[1:] |= turn & (step < -1)
    return edges


def _gradients(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Length of the central differences, gray levels a pixel."""
    return np.hypot(*np.gradient(image))


@pytest.mark.parametrize("camera", ["image_00", "image_02", "image_03"])
def test_lidar_edges_lie_on_image_edges_for_a_clockwise_turn(raw, camera):
    """The median gradient at edges of the lidar: 11.4 on image_02 for the turn that is read, 11.0 for points as they
    are, 10.1 for the other direction; on the others 9.2 to 9.3, 8.9 to 9.1 and 8.5 to 8.6. On the right half of
    image_02, where the car moves a fifth of a degree while the lidar passes, 8.1, 7.0 and 5.4."""
    reader = KittiReader(root=raw, drive=SAMPLE, cameras=[camera])
    recording, drive, parts = reader.recording(), reader._drive(), reader._parts()
    points, (begin, end) = read_points(drive.sweep(0)), parts.turns[0]
    stamp, clockwise = parts.clock.stamps[0], point_stamps(points, begin, end)
    path = parts.oxts[0].path(parts.poses[0], stamp, begin, end)
    image = recording.read_image(recording.shots[0]).double().numpy() @ [0.299, 0.587, 0.114]
    gradients, edges = torch.from_numpy(_gradients(image)), _edges(points)
    medians = []
    for stamps in (clockwise, torch.full_like(clockwise, stamp), begin + end - clockwise):
        world = untwisted(transform_points(parts.calibration.imu_from_lidar, points[edges]), stamps[edges], path)
        seen = transform_points(inverse(recording.shots[0].world_from_camera), world)
        pixels = seen @ recording.rig[0].intrinsics.double().T
        column, row = (pixels[:, :2] / pixels[:, 2:]).unbind(-1)
        inside = (seen[:, 2] > 1) & (column >= 1) & (column < 1241) & (row >= 1) & (row < 374)
        medians.append(float(gradients[row[inside].long(), column[inside].long()].median()))
    right, still, left = medians
    assert right > max(still, left)
    if camera == "image_02":
        assert right >= 10


def test_its_velocity_is_seen_from_the_car(raw):
    """The file has it twice, by compass, which is read, and ahead and to the left of the car: as fast, but 1.7 degrees
    apart, in a curve of 0.145 rad/s."""
    path = raw / "2011_09_26" / f"{SAMPLE}_sync" / "oxts" / "data" / "0000000000.txt"
    ahead, left, up = np.array(path.read_text().split(), float)[8:11]
    velocity = read_oxts(path).velocity
    assert np.linalg.norm(velocity) == pytest.approx(np.linalg.norm([ahead, left, up]), rel=1e-4)
    assert abs(np.arctan2(velocity[1], velocity[0]) - np.arctan2(left, ahead)) < np.radians(1.8)


def test_tracklets_are_those_of_the_drive(tracklets):
    names = [tracklet.class_name for tracklet in tracklets]
    assert {name: names.count(name) for name in set(names)} == {"Car": 12, "Cyclist": 2, "Tram": 1}
    assert sum(len(tracklet.frames) for tracklet in tracklets) == 572
    assert sum(tracklet.num_unset for tracklet in tracklets) == 0
    assert tracklets[0].size.tolist() == [4.3293562, 1.7057118, 2.1672349]


def test_boxes_stand_on_the_ground(tracklets):
    """Within 0.3 m of the plane through the ground of each frame, for those within 25 m: mean of the drive's boxes."""
    root = _sample("kitti_0001")
    gaps = []
    for frame in range(0, 60, 3):
        points = np.fromfile(root / "lidar" / f"{frame:03d}.bin", "<f4").reshape(-1, 4)[:, :3].astype(float)
        plane = _ground(points)
        for tracklet in tracklets:
            for pose in tracklet.lidar_from_object[tracklet.frames == frame + 20].numpy():
                bottom = pose[:3, 3] - 0.5 * tracklet.size[2] * pose[:3, 2]
                if np.hypot(*bottom[:2]) < 25:
                    gaps.append(bottom[2] - plane @ [bottom[0], bottom[1], 1])
    assert len(gaps) > 20
    assert np.abs(np.median(gaps)) < 0.3


def _ground(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """a, b, c of z = a x + b y + c through the lowest points, by least squares that leave out what lies above."""
    low = points[(np.hypot(points[:, 0], points[:, 1]) < 25) & (points[:, 2] < -1.2)]
    for _ in range(10):
        design = np.column_stack([low[:, :2], np.ones(len(low))])
        plane = np.linalg.lstsq(design, low[:, 2], rcond=None)[0]
        low = low[low[:, 2] - design @ plane < 0.1]
    return plane


def test_boxes_are_those_of_the_same_drive_in_another_layout(tracklets):
    """The sample in DriveStudio's layout has the same boxes by poses of its own: 1 mm, as its numbers are rounded."""
    log = DriveStudioReader(_sample("kitti_0001")).read()
    poses = {}
    for frame in range(60):
        text = (_sample("kitti_0001") / "lidar_pose" / f"{frame:03d}.txt").read_text().split()
        poses[frame] = torch.tensor(list(map(float, text)), dtype=torch.float64).view(4, 4)
    back = inverse(log.dataset_from_world)
    theirs = {(track.class_name, int(frame)): [] for track in log.tracks for frame in track.frames}
    for track in log.tracks:
        for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
            theirs[track.class_name, frame].append((pose, track.size))
    compared = 0
    for tracklet in tracklets:
        for frame, pose in zip((tracklet.frames - 20).tolist(), tracklet.lidar_from_object, strict=True):
            if (tracklet.class_name, frame) in theirs:
                ours = back @ poses[frame] @ pose
                gaps = [float((ours - other).abs().max()) for other, _ in theirs[tracklet.class_name, frame]]
                sizes = [other for _, other in theirs[tracklet.class_name, frame]]
                assert min(gaps) < 2e-3
                nearest = sizes[int(np.argmin(gaps))].double().numpy()
                assert np.abs(nearest - tracklet.size).max() < 1e-3
                compared += 1
    assert compared > 200


PLAN = Plan()


def test_pykitti_has_the_same_poses_and_calibration(tmp_path):
    """It counts from the first frame. Its place of a camera is p_x / f alone: with a third number of 2.7 mm that is off
    by 2.7 mm cx / f along x, and by all of y and z."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of pandas, which it imports
        pykitti = pytest.importorskip("pykitti", reason="pykitti is not installed (with --no-deps, and pandas)")
    write_kitti(tmp_path, PLAN)
    path = tmp_path / DATE / "calib_cam_to_cam.txt"
    lines = path.read_text().splitlines()
    # It wants all four cameras: image_01 is a copy of image_00 here.
    path.write_text("\n".join([*lines, *(line.replace("_00:", "_01:") for line in lines if "_00:" in line)]))
    theirs = pykitti.raw(str(tmp_path), DATE, DRIVE.rpartition("_")[2])
    recording = KittiReader(root=tmp_path, drive=DRIVE).recording()
    poses = recording.vehicle.poses.numpy()
    for pose, one in zip(poses, theirs.oxts, strict=True):
        wanted = one.T_w_imu.copy()
        wanted[:3, 3] += poses[0][:3, 3]
        assert np.abs(pose - wanted).max() < 1e-7
    ours = read_calibration(tmp_path / DATE, ["image_00", "image_02", "image_03"])
    assert np.abs(inverse(ours.imu_from_lidar).numpy() - theirs.calib.T_velo_imu).max() < 1e-12
    for name in ("image_00", "image_02", "image_03"):
        number = name[-2:]
        from_imu = inverse(ours.imu_from_camera[name]) @ ours.imu_from_lidar
        gap = getattr(theirs.calib, f"T_cam{int(number)}_velo") - from_imu.numpy()
        _, y, z = RECTIFIED_PLACES[number]
        matrix = PLAN.cameras[0].intrinsics
        wanted = [z * (matrix[0, 2] - 0.5) / matrix[0, 0], -y, -z]
        assert np.abs(gap - np.column_stack([np.zeros((4, 3)), [*wanted, 0]])).max() < 1e-12
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
