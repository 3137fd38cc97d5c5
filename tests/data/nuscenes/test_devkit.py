"""nuScenes' own devkit reads the drive as the reader does."""

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.data.nuscenes import NuScenesReader
from tests.data.nuscenes.written import sweep_end, write_nuscenes
from tests.data.plan import Plan
from tests.typed import there

_PIXELS = Image.MAX_IMAGE_PIXELS
devkit = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
data_classes = pytest.importorskip("nuscenes.utils.data_classes")
Quaternion = pytest.importorskip("pyquaternion").Quaternion
# It lifts Pillow's limit for all.
Image.MAX_IMAGE_PIXELS = _PIXELS
PLAN = Plan()


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple:
    root = write_nuscenes(tmp_path_factory.mktemp("nuscenes") / "drive", PLAN).root
    return devkit.NuScenes("v1.0-mini", str(root), verbose=False), NuScenesReader(root=root).recording()


def samples(theirs) -> list[dict]:
    """In the order of the chain."""
    found, token = [], theirs.scene[0]["first_sample_token"]
    while token:
        found.append(theirs.get("sample", token))
        token = found[-1]["next"]
    return found


def test_poses_and_intrinsics_of_images(both):
    theirs, recording = both
    for shot in recording.shots:
        channel = recording.rig[shot.camera].name
        data = theirs.get("sample_data", samples(theirs)[shot.frame]["data"][channel])
        mount = theirs.get("calibrated_sensor", data["calibrated_sensor_token"])
        ego = theirs.get("ego_pose", data["ego_pose_token"])
        rotation = Quaternion(ego["rotation"]) * Quaternion(mount["rotation"])
        center = Quaternion(ego["rotation"]).rotate(np.array(mount["translation"])) + ego["translation"]
        assert np.allclose(shot.world_from_camera[:3, :3], rotation.rotation_matrix, rtol=0, atol=1e-12)
        assert np.allclose(shot.world_from_camera[:3, 3], center, rtol=0, atol=1e-11)
        shift = recording.rig[shot.camera].intrinsics.double().numpy() - mount["camera_intrinsic"]
        assert np.allclose(shift, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], rtol=0, atol=1e-5)
        assert theirs.get_sample_data_path(data["token"]) == str(shot.key)


def test_boxes_at_keyframes(both):
    theirs, recording = both
    (boxes,) = there(recording.boxes)
    for frame, sample in enumerate(samples(theirs)):
        (box,) = theirs.get_boxes(sample["data"]["LIDAR_TOP"])
        assert 1000 * sample["timestamp"] == boxes.stamps[frame] == sweep_end(PLAN, frame)
        assert np.allclose(boxes.poses[frame, :3, 3], box.center, rtol=0, atol=1e-11)
        assert np.allclose(boxes.poses[frame, :3, :3], box.rotation_matrix, rtol=0, atol=1e-12)
        assert box.wlh[[1, 0, 2]].tolist() == boxes.sizes[frame].tolist()
        # The devkit's corners: x along the length, y left, z up.
        signs = box.corners()[:, 0] - box.center
        ours = boxes.poses[frame, :3, :3] @ (boxes.sizes[frame] / 2)
        assert np.allclose(signs, ours, rtol=0, atol=1e-9)
        assert box.name == boxes.class_name


def test_points(both):
    theirs, recording = both
    for frame, sample in enumerate(samples(theirs)):
        data = theirs.get("sample_data", sample["data"]["LIDAR_TOP"])
        cloud = data_classes.LidarPointCloud.from_file(theirs.get_sample_data_path(data["token"]))
        near = np.linalg.norm(cloud.points[:3], axis=0) < 2.5
        assert near.sum() == 1
        mount = theirs.get("calibrated_sensor", data["calibrated_sensor_token"])
        ego = theirs.get("ego_pose", data["ego_pose_token"])
        points = cloud.points[:3, ~near].astype(float)
        for pose in (mount, ego):
            points = Quaternion(pose["rotation"]).rotation_matrix @ points + np.array(pose["translation"])[:, None]
        assert torch.allclose(there(recording.sweeps)[frame].read(), torch.from_numpy(points.T), rtol=0, atol=1e-9)
