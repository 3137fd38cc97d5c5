"""Argoverse's own library reads the planned log as we do. It needs numba and more, so mostly it is not there."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.argoverse2 import Argoverse2Reader
from sparsestreet.geometry.cameras import inverse, project
from tests.data.argoverse2.write import CAMERAS, LOG, write_log
from tests.typed import there

pytest.importorskip("pyarrow", reason="feather files need pyarrow")
loading = pytest.importorskip("av2.datasets.sensor.av2_sensor_dataloader", reason="av2 is not installed")
structures = pytest.importorskip("av2.structures.sweep", reason="av2 is not installed")


def test_their_poses_cameras_points_and_boxes_are_ours(tmp_path):
    log = write_log(tmp_path / "first")
    ours = Argoverse2Reader(root=log, cameras=list(CAMERAS)).recording()
    theirs = loading.AV2SensorDataLoader(data_dir=log.parent, labels_dir=log.parent)
    stamps = theirs.get_ordered_log_lidar_timestamps(LOG)
    assert there(ours.frame_stamps) == tuple(stamps)
    for frame, stamp in enumerate(stamps):
        city_from_ego = theirs.get_city_SE3_ego(LOG, stamp)
        sweep = structures.Sweep.from_feather(Path(theirs.get_lidar_fpath(LOG, stamp)))
        points = city_from_ego.transform_point_cloud(sweep.xyz.astype(np.float64))
        np.testing.assert_allclose(there(ours.sweeps)[frame].read().numpy(), points, atol=1e-6)
        boxes = {one.category: one for one in theirs.get_labels_at_lidar_timestamp(LOG, stamp).cuboids}
        for box in there(ours.boxes):
            if frame in box.frames.tolist():
                row, cuboid = box.frames.tolist().index(frame), boxes[box.class_name]
                pose = city_from_ego.compose(cuboid.dst_SE3_object).transform_matrix
                np.testing.assert_allclose(box.poses[row], pose, atol=1e-6)
                assert box.sizes[row].tolist() == [cuboid.length_m, cuboid.width_m, cuboid.height_m]
    for camera in ours.rig:
        pinhole = theirs.get_log_pinhole_camera(LOG, camera.name)
        (shot,) = (one for one in ours.shots if (one.frame, one.camera) == (1, camera.index))
        assert Path(str(shot.key)) in theirs.get_ordered_log_cam_fpaths(LOG, camera.name)
        # Points of the sweep in the image: their pixels have centers at whole numbers, ours at +0.5.
        ego_from_city = np.linalg.inv(
            shot.world_from_camera.numpy() @ np.linalg.inv(pinhole.ego_SE3_cam.transform_matrix)
        )
        city = there(ours.sweeps)[1].read()
        ego = city.numpy() @ ego_from_city[:3, :3].T + ego_from_city[:3, 3]
        pixels, _, seen = pinhole.project_ego_to_img(ego)
        local = city @ inverse(shot.world_from_camera)[:3, :3].T + inverse(shot.world_from_camera)[:3, 3]
        mine, _, inside = project(camera.at(torch.eye(4, dtype=torch.float64)), local.float())
        assert inside.sum() > 10
        both = inside.numpy() & seen
        np.testing.assert_allclose(mine.numpy()[both], pixels[both][:, :2] + 0.5, atol=1e-3)  # float32 of ours
