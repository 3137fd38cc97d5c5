"""One drive as nuScenes' tables and in DriveStudio's layout, and one genuine keyframe of nuScenes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.convert import Source, convert
from sparsestreet.data.drivestudio import DriveStudioReader, DriveStudioWriter
from sparsestreet.data.drivestudio.annotations import class_in
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.nuscenes import NuScenesReader
from sparsestreet.data.recording import Recording
from sparsestreet.geometry.cameras import inverse, transform_points
from tests.data.nuscenes.keyframe import summary_of, write_keyframe
from tests.data.nuscenes.written import sweep_end, token, write_nuscenes
from tests.data.plan import Plan, check_same_masks, check_same_sweeps, check_same_track, check_same_views
from tests.typed import there

pytestmark = pytest.mark.lengthy


@pytest.fixture(scope="module")
def drivestudio(kitti) -> DrivingLog:
    return DriveStudioReader(kitti).read()


@pytest.fixture(scope="module")
def tables(recorded) -> DrivingLog:
    """The converted tables count pixels from the corner."""
    return NuScenesReader(root=recorded("kitti_0001_nuscenes"), principal_shift=0).read()


def world_from_other(log: DrivingLog, other: DrivingLog) -> torch.Tensor:
    """Both worlds start at the first camera, and each keeps the axes of its data set: a rotation is between them."""
    return inverse(log.views[0].camera.camera_from_world.double()) @ other.views[0].camera.camera_from_world.double()


def test_the_same_views(tables, drivestudio):
    assert (tables.num_frames, tables.num_cameras) == (drivestudio.num_frames, drivestudio.num_cameras) == (60, 2)
    turn = world_from_other(tables, drivestudio)
    for ours, theirs in zip(tables.views, drivestudio.views, strict=True):
        assert (ours.indices, ours.camera.width, ours.camera.height) == (theirs.indices, 397, 120)
        # The text files have seconds with 9 digits since the first frame, tables microseconds.
        assert there(ours.seconds) == pytest.approx(there(theirs.seconds), abs=1e-6)
        assert torch.allclose(ours.camera.intrinsics, theirs.camera.intrinsics, rtol=1e-7)
        # Poses went through quaternions and 10 digits on their way into the tables: 2 micrometers, then float32.
        same = theirs.camera.camera_from_world.double() @ inverse(turn)
        assert torch.allclose(ours.camera.camera_from_world.double(), same, rtol=0, atol=2e-5)


def test_the_same_boxes(tables, drivestudio):
    turn = world_from_other(tables, drivestudio)
    classes = {"Car": "vehicle.car", "Cyclist": "vehicle.bicycle", "Tram": "vehicle.bus.rigid"}
    assert len(tables.tracks) == len(drivestudio.tracks) == 12
    for theirs in drivestudio.tracks:
        moved = turn @ theirs.world_from_object
        (ours,) = (
            track
            for track in tables.tracks
            if track.frames.tolist() == theirs.frames.tolist()
            and torch.allclose(track.world_from_object, moved, rtol=0, atol=1e-5)
        )
        assert ours.class_name == classes[theirs.class_name]
        assert torch.allclose(ours.size, theirs.size, rtol=1e-7)


def test_the_same_pixels_and_returns(tables, drivestudio):
    turn = world_from_other(tables, drivestudio)
    for place in (0, 61, 119):
        ours, theirs = tables.frames[place], drivestudio.frames[place]
        assert torch.equal(ours.image, theirs.image)
        # Points that lie on the line between two pixels may fall into either.
        assert ((ours.depth > 0) == (theirs.depth > 0)).float().mean() > 0.9999
        both = (ours.depth > 0) & (theirs.depth > 0)
        assert ((ours.depth - theirs.depth).abs()[both] < 1e-3).float().mean() > 0.999
        moved = transform_points(turn, drivestudio.sweeps[place // 2].points.double())
        # float32 in the world: steps of 1e-5 m at 100 m.
        assert torch.allclose(tables.sweeps[place // 2].points.double(), moved, rtol=0, atol=5e-5)


def test_files_between_keyframes_are_the_same_instants(recorded, tables):
    """At 2 Hz with all images: the views and sweeps of the drive whose every frame is a keyframe."""
    root = recorded("kitti_0001_nuscenes_2hz")
    log = NuScenesReader(root=root, principal_shift=0, rate="all").read()
    assert [view.stamp for view in log.views] == [view.stamp for view in tables.views]
    assert torch.equal(log.views[77].camera.camera_from_world, tables.views[77].camera.camera_from_world)
    assert torch.equal(log.sweeps[38].points, tables.sweeps[38].points)
    assert NuScenesReader(root=root).read().num_frames == 12


@pytest.fixture(scope="module")
def keyframe(recorded, tmp_path_factory) -> Recording:
    root = tmp_path_factory.mktemp("keyframe") / "nuscenes"
    return NuScenesReader(root=write_keyframe(recorded("nuscenes_one_keyframe"), root).root).recording()


def test_a_genuine_sweep_is_whole_firings_of_32_rings(recorded):
    folder = recorded("nuscenes_one_keyframe")
    points = np.fromfile(folder / summary_of(folder)["lidar_points"]["lidar_path"], "<f4").reshape(-1, 5)
    assert len(points) == 34_688
    assert (points[:, 4].reshape(-1, 32) == np.arange(32)).all()
    # What is nearer than 2.5 m is the recording car: nothing lies between 2.2 m and 3 m.
    ranges = np.linalg.norm(points[:, :3], axis=1)
    assert ((ranges > 2.2) & (ranges < 3)).sum() == 0


def test_a_genuine_keyframe(keyframe):
    assert [camera.name for camera in keyframe.rig] == [
        "CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"
    ]  # fmt: skip
    (stamp,) = there(keyframe.frame_stamps)
    before = [round((stamp - there(shot.stamp)) / 1e5) / 10 for shot in keyframe.shots]
    assert before == [35.5, 43.1, 27.6, 0.5, 20.1, 10.4]
    assert len(there(keyframe.sweeps)[0].read()) == 26_162
    assert "3 objects that no lidar or radar return hit at any keyframe are left out" in keyframe.notes
    assert [there(keyframe.read_masks(shot)).keys() for shot in keyframe.shots[4:]] == [set(), {"ego"}]


def test_genuine_boxes_hold_the_returns_that_annotators_counted(recorded, keyframe):
    """An oracle of axes, sizes, poses and the world of the points.

    The summary has float32 poses, and yaws without the tilt of the boxes: 88 % of the boxes have exactly as many, all
    boxes together 1.5 % less.
    """
    points = there(keyframe.sweeps)[0].read().numpy()
    said = {
        token(n): one["num_lidar_pts"]
        for n, one in enumerate(summary_of(recorded("nuscenes_one_keyframe"))["instances"])
    }
    counts = []
    for boxes in there(keyframe.boxes):
        inside = np.abs((points - boxes.poses[0, :3, 3]) @ boxes.poses[0, :3, :3]) <= boxes.sizes[0] / 2
        counts.append((inside.all(1).sum(), said[boxes.name]))
    ours, theirs = np.array(counts).T
    assert len(counts) == 66
    assert (ours == theirs).mean() > 0.85
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.02)


FRAMES = 12


def check_converted(log: DrivingLog, folder: Path) -> None:
    """Frames, poses, returns and boxes of what is written and read again."""
    convert(log, Source(log.name, "0" * 12), DriveStudioWriter(jpeg_quality=None), folder)
    assert DriveStudioReader(folder).check() == []
    found = DriveStudioReader(folder).read()
    check_same_views(found, log)
    check_same_sweeps(found, log)
    moved = 0
    for one, other in zip(found.frames, log.frames, strict=True):
        assert torch.equal(one.image, other.image)
        check_same_masks(one, other)
        assert one.depth is not None
        assert other.depth is not None
        moved += int(((one.depth - other.depth).abs() > 1e-4).sum())
    # Returns are rounded to 4 micrometers: of 400,000 few lie so near to the border of a pixel.
    assert moved < 40
    known = [class_in("nuscenes", track.class_name) for track in log.tracks]
    assert [track.class_name for track in found.tracks] == known
    for one, other in zip(found.tracks, log.tracks, strict=True):
        check_same_track(found, one, log, other)
    assert found.radius == pytest.approx(log.radius, rel=1e-6)


def test_drivestudios_layout(kitti, tmp_path):
    log = DriveStudioReader(kitti, last_frame=FRAMES - 1).read()
    check_converted(log, tmp_path / "out")


def test_nuscenes_tables(recorded, tmp_path):
    reader = NuScenesReader(root=recorded("kitti_0001_nuscenes"), principal_shift=0, last_frame=FRAMES - 1)
    check_converted(reader.read(), tmp_path / "out")


def test_the_devkit_has_the_same_poses_boxes_and_points(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", Image.MAX_IMAGE_PIXELS)  # the devkit lifts Pillow's limit for all
    devkit = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
    clouds = pytest.importorskip("nuscenes.utils.data_classes").LidarPointCloud
    turn = pytest.importorskip("pyquaternion").Quaternion
    plan, root = Plan(), write_nuscenes(tmp_path / "drive", Plan()).root
    theirs, recording = devkit.NuScenes("v1.0-mini", str(root), verbose=False), NuScenesReader(root=root).recording()
    samples = sorted(theirs.sample, key=lambda sample: sample["timestamp"])
    (boxes,) = there(recording.boxes)

    def opened(frame: int, channel: str) -> tuple[dict, list[dict]]:
        """The row of a file, and where its sensor and the car were."""
        data = theirs.get("sample_data", samples[frame]["data"][channel])
        tables = (("calibrated_sensor", "calibrated_sensor_token"), ("ego_pose", "ego_pose_token"))
        return data, [theirs.get(table, data[token]) for table, token in tables]

    for shot in recording.shots:
        camera = recording.rig[shot.camera]
        data, (mount, ego) = opened(shot.frame, camera.name)
        rotation = turn(ego["rotation"]) * turn(mount["rotation"])
        center = turn(ego["rotation"]).rotate(np.array(mount["translation"])) + ego["translation"]
        assert np.allclose(shot.world_from_camera[:3, :3], rotation.rotation_matrix, rtol=0, atol=1e-12)
        assert np.allclose(shot.world_from_camera[:3, 3], center, rtol=0, atol=1e-11)
        shift = camera.intrinsics.double().numpy() - mount["camera_intrinsic"]
        assert np.allclose(shift, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], rtol=0, atol=1e-5)
        assert theirs.get_sample_data_path(data["token"]) == str(shot.key)
    for frame, sample in enumerate(samples):
        data, placed = opened(frame, "LIDAR_TOP")
        (box,) = theirs.get_boxes(data["token"])
        assert 1000 * sample["timestamp"] == boxes.stamps[frame] == sweep_end(plan, frame)
        assert np.allclose(boxes.poses[frame, :3, 3], box.center, rtol=0, atol=1e-11)
        assert np.allclose(boxes.poses[frame, :3, :3], box.rotation_matrix, rtol=0, atol=1e-12)
        # The devkit's first corner: ahead, to the left, above.
        corner = boxes.poses[frame, :3, :3] @ (boxes.sizes[frame] / 2)
        assert np.allclose(box.corners()[:, 0] - box.center, corner, rtol=0, atol=1e-9)
        assert box.name == boxes.class_name
        points = clouds.from_file(theirs.get_sample_data_path(data["token"])).points[:3].astype(float)
        points = points[:, np.linalg.norm(points, axis=0) >= 2.5]
        for pose in placed:
            points = turn(pose["rotation"]).rotation_matrix @ points + np.array(pose["translation"])[:, None]
        assert torch.allclose(there(recording.sweeps)[frame].read(), torch.from_numpy(points.T), rtol=0, atol=1e-9)
