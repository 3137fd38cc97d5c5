"""``examples/own_log.py`` turns a log of somebody's own into one that is read as it was planned."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from sparsestreet.data.rig_json import RigJsonReader
from tests.data.plan import Plan, moved
from tests.typed import there

EXAMPLES = Path(__file__).parents[3] / "examples"
PLAN = Plan()
CAMERAS = tuple(replace(camera, delay=0) for camera in PLAN.cameras)
"""Cameras that expose at the stamps of the frames, as the example has it."""


def write_own(folder: Path) -> None:
    def table(name: str, header: str, rows: list[list]) -> None:
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([header.split(","), *rows])

    said = {}
    for camera in CAMERAS:
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        said[camera.name] = {"size": [camera.width, camera.height], "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
        said[camera.name]["vehicle_from_camera"] = camera.vehicle_from_camera.tolist()
        (folder / camera.name).mkdir()
    (folder / "cameras.json").write_text(json.dumps(said))
    (folder / "lidar").mkdir()
    poses, boxes = [], []
    for frame, stamp in enumerate(PLAN.stamps):
        vehicle = PLAN.world_from_vehicle(int(stamp))
        x, y, z, w = Rotation.from_matrix(vehicle[:3, :3]).as_quat()
        poses.append([stamp, *vehicle[:3, 3], w, x, y, z])
        box = np.linalg.inv(vehicle) @ PLAN.world_from_box(int(stamp))
        yaw = np.arctan2(box[1, 0], box[0, 0])
        boxes.append([stamp, "car-1", "car", *box[:3, 3], *PLAN.box_size, yaw])
        for camera in CAMERAS:
            Image.fromarray(PLAN.image(frame, camera)).save(folder / camera.name / f"{stamp}.png")
        points = moved(np.linalg.inv(vehicle), PLAN.world_points(frame))
        np.column_stack((points, np.zeros(len(points)))).astype(np.float32).tofile(folder / "lidar" / f"{stamp}.bin")
    table("poses.csv", "stamp,x,y,z,qw,qx,qy,qz", poses)
    table("boxes.csv", "stamp,track,class,x,y,z,length,width,height,yaw", boxes)


@pytest.fixture
def converted(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    write_own(tmp_path)
    import own_log  # pyright: ignore[reportMissingImports]

    yield tmp_path, own_log.main
    sys.modules.pop("own_log")


def test_a_log_of_ones_own_is_read_as_it_was_planned(converted, capsys):
    folder, convert = converted
    convert(folder)
    (said,) = capsys.readouterr().out.splitlines()
    assert said.startswith(
        f"{folder}/rig.json: frames: 4, cameras: {len(CAMERAS)}, tracks of boxes: 1; now sparsestreet"
    )
    reader = RigJsonReader(root=folder)
    assert reader.check() == []
    recording = reader.recording()
    for shot in recording.shots:
        expected = PLAN.world_from_camera(shot.frame, CAMERAS[shot.camera])
        np.testing.assert_allclose(shot.world_from_camera.numpy(), expected, atol=1e-9)
    for frame, sweep in there(recording.sweeps).items():
        # Written as float32, 45 m away.
        np.testing.assert_allclose(sweep.read().numpy(), PLAN.world_points(frame), atol=1e-5)
    (boxes,) = there(recording.boxes)
    assert (boxes.name, boxes.class_name) == ("car-1", "car")
    np.testing.assert_allclose(boxes.sizes, [PLAN.box_size] * 4)
    centers = PLAN.world_from_box(PLAN.stamps)[:, :3, 3]
    np.testing.assert_allclose(boxes.poses[:, :3, 3], centers, atol=1e-9)
    for frame in reader.read().frames:
        camera = CAMERAS[frame.camera_index]
        torch.testing.assert_close(frame.camera.intrinsics.double(), torch.from_numpy(camera.intrinsics))


def test_lidar_and_boxes_may_be_absent(converted):
    folder, convert = converted
    for path in [folder / "boxes.csv", *(folder / "lidar").iterdir()]:
        path.unlink()
    convert(folder)
    log = RigJsonReader(root=folder).read()
    assert len(log.frames) == 8
    assert len(log.tracks) == 0
