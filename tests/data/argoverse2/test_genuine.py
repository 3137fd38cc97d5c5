"""What holds of genuine logs: poses at the sweeps, and the points that the data set counts in each box."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from sparsestreet.data.argoverse2 import Argoverse2Reader
from sparsestreet.data.argoverse2.reader import (
    Layout,
    find_log,
    read_boxes,
    read_cameras,
    read_lidar,
    read_path,
    read_sweep,
    stamped_files,
)
from sparsestreet.data.problems import LogError
from sparsestreet.geometry.cameras import inverse, project
from tests.data.argoverse2.write import CAMERAS, LOG, read_table, write_log
from tests.typed import there

pytest.importorskip("pyarrow", reason="feather files need pyarrow")


GENUINE = "7fab2350"


@pytest.fixture(scope="module")
def genuine() -> Path:
    default = Path(__file__).resolve().parents[4] / "shared" / "data"
    root = Path(os.environ.get("SPARSESTREET_DATA", default)) / "av2_sensor"
    if not root.is_dir():
        pytest.skip(f"no logs of Argoverse 2 at {root}: set SPARSESTREET_DATA to the folder that holds av2_sensor")
    return root


@pytest.fixture(scope="module")
def layout(genuine) -> Layout:
    return find_log(genuine, GENUINE)


def test_each_sweep_has_a_pose_of_exactly_its_stamp(layout):
    table = read_table(layout.poses)
    stamps = list(stamped_files(layout.sweeps, ".feather"))
    rows = [int(np.flatnonzero(table["timestamp_ns"] == stamp)[0]) for stamp in stamps]
    assert rows == [1983, 2000]
    path, duplicates = read_path(layout)
    assert (duplicates, len(path.stamps)) == (314, 2706 - 314)
    positions = np.stack([table[name][rows] for name in ("tx_m", "ty_m", "tz_m")], -1)
    # A row of the pair may be the one that is left out; its neighbor stands up to 1e-6 m away.
    np.testing.assert_allclose(path.at(torch.tensor(stamps))[:, :3, 3].numpy(), positions, atol=1e-6)


def test_every_box_holds_as_many_points_as_the_data_set_counts(layout):
    """Points as they are stored (float16), in the vehicle's frame, of two sweeps: 162 boxes."""
    path, _ = read_path(layout)
    sweeps = stamped_files(layout.sweeps, ".feather")
    boxes, homeless = read_boxes(layout, list(sweeps), {stamp: place for place, stamp in enumerate(sweeps)}, path)
    counted = read_table(layout.boxes)
    known = {
        (stamp, name): number
        for stamp, name, number in zip(
            counted["timestamp_ns"], counted["track_uuid"], counted["num_interior_pts"], strict=True
        )
    }
    checked = 0
    for place, (stamp, file) in enumerate(sweeps.items()):
        city_from_ego = path.at(torch.tensor([stamp]))[0]
        points = read_sweep(file, city_from_ego).numpy()
        for box in boxes:
            for row in np.flatnonzero(box.frames == place):
                inside = (points - box.poses[row, :3, 3]) @ box.poses[row, :3, :3]
                found = int((np.abs(inside) <= box.sizes[row] / 2).all(1).sum())
                assert found == known[stamp, box.name], box.name
                checked += 1
    assert checked == 162
    assert homeless == len(counted["timestamp_ns"]) - 162


def test_its_cameras_are_pinholes_and_one_stands_upright(layout):
    cameras = read_cameras(layout)
    assert len(cameras) == 9
    assert {name for name, camera in cameras.items() if camera.size == (1550, 2048)} == {"ring_front_center"}
    assert {camera.size for name, camera in cameras.items() if name != "ring_front_center"} == {(2048, 1550)}
    front = cameras["ring_front_center"]
    assert front.intrinsics[0].tolist() == pytest.approx([1776.0414843455, 0, 777.9905731522801 + 0.5])
    # Looks ahead, and its image's y goes down.
    assert front.ego_from_camera[0, 2] > 0.99
    assert front.ego_from_camera[2, 1] < -0.99
    stood = there(read_lidar(layout))
    assert float((stood - front.ego_from_camera[:3, 3]).norm()) < 0.5
    assert stood.tolist() == pytest.approx([1.35018, 0.0, 1.64042], abs=1e-5)


def test_a_log_whose_images_were_not_fetched_is_refused_in_words(genuine):
    (problem,) = Argoverse2Reader(root=genuine, scene=GENUINE).check()
    assert problem.message == "there are no images"
    with pytest.raises(LogError, match="fetch those of the cameras that you want"):
        Argoverse2Reader(root=genuine, scene=GENUINE).read()


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
