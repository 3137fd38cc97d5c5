"""A drive described by hand is read as it was planned."""

import csv
import json
import re
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from sparsestreet.data.recording import Recording
from sparsestreet.data.rig_json import RigJsonReader
from sparsestreet.data.rig_json.table import LENSES
from tests.data.plan import Plan, levels, moved
from tests.data.rig_json.write import in_lidar, write_json
from tests.typed import there

PLAN = Plan()
CHORD = 0.015
"""Meters between the plan's circle (r = 50 m) and a line between two of its frames, half a frame behind them too."""
PAGE = Path(__file__).parents[3] / "docs" / "datasets" / "rig_json.md"


@pytest.fixture(scope="module")
def recording(root) -> Recording:
    return RigJsonReader(root=root).recording()


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return RigJsonReader(root=root).read()


def test_the_vehicle_is_where_it_was_at_the_frames_of_the_window(root):
    vehicle = there(RigJsonReader(root=root, first_frame=1, last_frame=2).recording().vehicle)
    assert vehicle.stamps.tolist() == PLAN.stamps[1:3].tolist()
    assert np.allclose(vehicle.poses, PLAN.world_from_vehicle(PLAN.stamps[1:3]), rtol=0, atol=1e-9)


def test_each_image_has_its_own_instant_and_pose(recording, log):
    assert [(shot.frame, shot.camera) for shot in recording.shots] == [(f, c) for f in range(4) for c in range(2)]
    for shot, frame in zip(recording.shots, log.frames, strict=True):
        camera = PLAN.cameras[shot.camera]
        assert shot.stamp == PLAN.image_stamp(shot.frame, camera)
        expected = PLAN.world_from_camera(shot.frame, camera)
        assert np.abs(shot.world_from_camera.numpy() - expected).max() < CHORD
        # At the frame's instant it would be 0.25 m and more away.
        late = PLAN.world_from_vehicle(int(PLAN.stamps[shot.frame])) @ camera.vehicle_from_camera
        assert np.abs(shot.world_from_camera.numpy() - late).max() > 0.2
        np.testing.assert_allclose(frame.camera.intrinsics.numpy(), camera.intrinsics, rtol=1e-7)
        assert (frame.image.numpy() == PLAN.image(shot.frame, camera)).all()
    assert recording.frame_stamps == tuple(PLAN.stamps.tolist())


def test_points_are_where_they_were(recording):
    for frame, sweep in there(recording.sweeps).items():
        points, expected = sweep.read().numpy(), PLAN.world_points(frame)
        assert np.abs(points - expected).max() < CHORD
        assert sweep.stamp == PLAN.stamps[frame]
        still = in_lidar(PLAN, frame)
        assert np.abs(still - PLAN.sweep(frame)[0]).max() > 0.3  # what the car's motion would do
        stood = PLAN.world_from_vehicle(int(PLAN.stamps[frame])) @ PLAN.vehicle_from_lidar
        assert np.abs(there(sweep.origin).numpy() - stood[:3, 3]).max() < 1e-9


def test_boxes_are_where_they_were(recording, log):
    (boxes,) = there(recording.boxes)
    assert (boxes.name, boxes.class_name, boxes.frames.tolist()) == (PLAN.box_name, "car", [0, 1, 2, 3])
    np.testing.assert_allclose(boxes.poses, PLAN.world_from_box(PLAN.stamps), atol=1e-9)
    np.testing.assert_allclose(boxes.sizes, [PLAN.box_size] * 4)
    assert boxes.stamps == tuple(PLAN.stamps.tolist())
    (track,) = log.tracks
    assert track.name == PLAN.box_name


def test_it_is_sound_and_lacks_only_masks(root, log):
    assert RigJsonReader(root=root).check() == []
    assert sorted(note.split(":")[0] for note in log.notes) == ["no human masks", "no sky masks", "no vehicle masks"]
    assert RigJsonReader(root=root, lidar=False).read().notes[-1].startswith("no lidar")
    assert RigJsonReader(root=root, cameras=["left"]).data_hash() != RigJsonReader(root=root).data_hash()


def test_a_window_counts_from_its_start(root):
    found = RigJsonReader(root=root, cameras=["left"], first_frame=2, width=16).recording()
    assert [(shot.frame, shot.camera) for shot in found.shots] == [(0, 0), (1, 0)]
    assert found.frame_stamps == tuple(PLAN.stamps.tolist()[2:])
    assert there(found.boxes)[0].frames.tolist() == [0, 1]
    assert there(found.boxes)[0].stamps == tuple(PLAN.stamps.tolist()[2:])
    assert np.abs(there(found.sweeps)[0].read().numpy() - PLAN.world_points(2)).max() < CHORD
    assert found.rig[0].size == (16, 12)


def test_an_image_may_have_its_own_pose(written):
    folder, content = written
    for frame, entry in enumerate(content["frames"]):
        for camera in PLAN.cameras:
            entry["images"][camera.name]["world_from_camera"] = PLAN.world_from_camera(frame, camera).tolist()
    for camera in content["cameras"].values():
        del camera["vehicle_from_camera"]
    write_json(folder, content)
    for shot in RigJsonReader(root=folder).recording().shots:
        expected = PLAN.world_from_camera(shot.frame, PLAN.cameras[shot.camera])
        np.testing.assert_allclose(shot.world_from_camera.numpy(), expected, atol=1e-9)


def test_a_declared_shutter_follows_the_drive(written):
    folder, content = written
    content["cameras"]["left"] |= {"shutter": {"readout": 0.04, "first": "right"}, "exposure": 0.003}
    write_json(folder, content)
    shots = RigJsonReader(root=folder).recording().shots
    for shot in shots:
        camera = PLAN.cameras[shot.camera]
        if camera.name == "front":
            assert (shot.shutter, shot.exposure) == (None, None)
            continue
        middle = PLAN.image_stamp(shot.frame, camera)
        begin, at, end = (
            PLAN.world_from_vehicle(middle + np.array([-20, 0, 20]) * 1_000_000) @ camera.vehicle_from_camera
        )
        shutter = there(shot.shutter)
        assert (shutter.direction, shot.exposure) == ("right", 0.003)
        # 0.4 m; velocity is constant between frames, and turns by 0.02 between two of them.
        expected = at[:3, :3].T @ (end - begin)[:3, 3]
        assert np.abs(shutter.translation.numpy() - expected).max() < 0.4 * 0.02
        # 0.2 rad/s about the world's z axis, which climbs by 0.03.
        turn = at[:3, :3].T @ np.array([0, 0, 0.2 * 0.04])
        assert np.abs(shutter.rotation.numpy() - turn).max() < 1e-5
    assert [view.camera.exposure for view in RigJsonReader(root=folder).read().views[:2]] == [
        0.003 if PLAN.cameras[index].name == "left" else 0.0 for index in range(2)
    ]


def test_without_a_clock_images_are_at_the_frames_pose(written):
    folder, content = written
    for entry in content["frames"]:
        del entry["stamp"]
        entry["images"] = {name: image["file"] for name, image in entry["images"].items()}
    content["lidar"]["columns"] = None
    for frame in range(4):
        np.save(folder / f"lidar/{frame:03d}.npy", in_lidar(PLAN, frame))
    write_json(folder, content)
    found = RigJsonReader(root=folder).recording()
    assert found.frame_stamps is None
    pose = PLAN.world_from_vehicle(int(PLAN.stamps[1])) @ PLAN.cameras[0].vehicle_from_camera
    np.testing.assert_allclose(found.shots[2].world_from_camera.numpy(), pose, atol=1e-9)
    np.testing.assert_allclose(there(found.sweeps)[3].read().numpy(), PLAN.world_points(3), atol=1e-6)


def test_points_in_other_files(written):
    """float32 in the lidar's frame, and a .ply in the world."""
    folder, content = written
    content["lidar"] = {"vehicle_from_lidar": PLAN.vehicle_from_lidar.tolist(), "nearest": 10.0}
    points = in_lidar(PLAN, 0)
    np.column_stack((points, 255 * levels(len(points)))).astype("<f4").tofile(folder / "lidar/000.bin")
    content["frames"][0]["lidar"] = {"file": "lidar/000.bin"}
    for frame in content["frames"][1:]:
        del frame["lidar"]
    write_json(folder, content)
    sweeps = there(RigJsonReader(root=folder).recording().sweeps)
    far = np.linalg.norm(points, axis=1) >= 10
    assert 0 < far.sum() < len(far)
    np.testing.assert_allclose(sweeps[0].read().numpy(), PLAN.world_points(0)[far], atol=1e-5)  # float32 of 45 m
    np.testing.assert_allclose(there(sweeps[0].intensities)(), levels(len(points))[far], atol=1e-6)
    assert list(sweeps) == [0]

    rows = np.empty(len(points), dtype=[(axis, "f8") for axis in "xyz"])
    for index, axis in enumerate("xyz"):
        rows[axis] = PLAN.world_points(0)[:, index]
    PlyData([PlyElement.describe(rows, "vertex")]).write(folder / "lidar/000.ply")
    del content["lidar"]
    content["frames"][0]["lidar"] = "lidar/000.ply"
    write_json(folder, content)
    sweeps = there(RigJsonReader(root=folder).recording().sweeps)
    np.testing.assert_allclose(sweeps[0].read().numpy(), PLAN.world_points(0), atol=1e-9)


def test_what_is_near_goes_with_its_times(written):
    folder, content = written
    content["lidar"]["nearest"] = 10.0
    write_json(folder, content)
    for frame, sweep in there(RigJsonReader(root=folder).recording().sweeps).items():
        far = np.linalg.norm(PLAN.sweep(frame)[0], axis=1) >= 10
        assert 0 < far.sum() < len(far)
        assert np.abs(sweep.read().numpy() - PLAN.world_points(frame)[far]).max() < CHORD


def test_an_image_has_the_same_pose_in_any_window(root, recording):
    """Images are taken after the stamp of their frame: those of a window's last one, beyond its path."""
    own = {(shot.frame, shot.camera): shot.world_from_camera for shot in recording.shots}
    for shot in RigJsonReader(root=root, first_frame=1, last_frame=2).recording().shots:
        assert torch.equal(shot.world_from_camera, own[shot.frame + 1, shot.camera])


def test_a_frame_without_images_is_left_out(written):
    folder, content = written
    del content["frames"][1]["images"]
    write_json(folder, content)
    found = RigJsonReader(root=folder).recording()
    assert found.frame_stamps == tuple(PLAN.stamps[[0, 2, 3]].tolist())
    assert there(found.boxes)[0].frames.tolist() == [0, 1, 2]
    np.testing.assert_allclose(there(found.boxes)[0].poses, PLAN.world_from_box(PLAN.stamps[[0, 2, 3]]), atol=1e-9)
    assert "1 of 4 frames have no image and are left out" in found.notes


def test_the_recording_car(written):
    folder, content = written
    hood = np.zeros((24, 32), np.uint8)
    hood[20:] = 255
    Image.fromarray(hood).save(folder / "hood.png")
    content["cameras"]["left"]["ego_mask"] = "hood.png"
    write_json(folder, content)
    frames = RigJsonReader(root=folder).read().frames
    assert frames[0].ego is None
    assert torch.equal(there(frames[1].ego), torch.from_numpy(hood > 0))
    hood[0, :2] = 90, 150
    Image.fromarray(hood).save(folder / "hood.png")
    (problem,) = RigJsonReader(root=folder).check()  # once, though it is that of four images
    assert (problem.path.name, "4 values" in problem.message) == ("hood.png", True)


def test_the_own_mask_and_the_given_one_are_one(written):
    folder, content = written
    own, given = np.zeros((2, 24, 32), np.uint8)
    own[20:], given[:, :3] = 255, 255
    Image.fromarray(own).save(folder / "hood.png")
    content["cameras"]["left"]["ego_mask"] = "hood.png"
    write_json(folder, content)
    masks = folder / "masks/ego/left"
    masks.mkdir(parents=True)
    for frame in range(4):
        Image.fromarray(given).save(masks / f"{frame:03d}.png")
    frames = RigJsonReader(root=folder, masks=folder / "masks").read().frames
    assert torch.equal(there(frames[1].ego), torch.from_numpy((own > 0) | (given > 0)))


NUMBERS = {"fx": 30.0, "fy": 31.0, "cx": 16.0, "cy": 12.0, "u0": 16.0, "v0": 12.0}


NUMBERS |= {"xi": 1.5, "gamma1": 90.0, "gamma2": 91.0}


NUMBERS |= {"polynomial": [0.0, 30.0, 0.0, -1.0], "linear": [1.0, 0.0, 0.0], "max_angle": 1.5}


@pytest.mark.parametrize("model", LENSES)
def test_lenses(model, written):
    """Every number of the model, all of them different; the page names them too."""
    folder, content = written
    names = [entry.name for entry in fields(LENSES[model]) if model != "pinhole" or entry.default is MISSING]
    lens = {name: NUMBERS.get(name, 1e-3 * (1 + place)) for place, name in enumerate(names)}
    content["cameras"]["front"]["lens"] = {"model": model} | lens
    write_json(folder, content)
    found = RigJsonReader(root=folder).recording().rig[0]
    wanted = LENSES[model](**{name: tuple(value) if isinstance(value, list) else value for name, value in lens.items()})  # pyright: ignore
    torch.testing.assert_close(found.intrinsics, wanted.pinhole.float())
    assert (found.undistortion is None) == (model in ("pinhole", "opencv"))
    rows = [row.split("|") for row in PAGE.read_text().splitlines() if row[:3] == "| `"]
    said = {row[1].strip(" `"): row[2] for row in rows}
    own = set(re.findall(r"[a-z_]+\d?", "".join(re.findall(r"`([^`]*)`", said[model]))))
    shared = {"opencv": "pinhole", "rational": "opencv"}.get(model)
    assert set(names) >= own
    assert set(names) - own <= ({entry.name for entry in fields(LENSES[shared])} if shared else set())


def test_the_page_can_be_followed(tmp_path):
    """Its example, and the files that it names."""
    (text,) = re.findall(r"```json\n(.*?)```", PAGE.read_text(), flags=re.S)
    assert len(text.splitlines()) <= 32
    (tmp_path / "rig.json").write_text(text)
    for name in re.findall(r'"(\w+/\d+\.png)"', text):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (640, 480), (90, 120, 150)).save(tmp_path / name)
    (tmp_path / "lidar").mkdir()
    rows = np.array([[10.0, 0, -1, 0.5, 0.05], [1.0, 0, 0, 0.5, 0.0]], dtype="<f4")
    rows.tofile(tmp_path / "lidar/000.bin")
    reader = RigJsonReader(root=tmp_path)
    assert reader.check() == []
    log = reader.read()
    assert [view.indices for view in log.views] == [(0, 0), (0, 1), (1, 0)]
    front, rear, later = (view.camera for view in log.views)
    assert front.intrinsics[0].tolist() == [500, 0, 320]
    assert front.distortion is not None
    assert rear.distortion is None
    # Cameras look ahead and back; the front one of frame 1 is 0.2 s * 10 m/s behind its first place... 1.2 m on.
    torch.testing.assert_close(front.camera_from_world[2, :3], torch.tensor([1.0, 0, 0]), rtol=0, atol=1e-6)
    torch.testing.assert_close(rear.camera_from_world[2, :3], torch.tensor([-1.0, 0, 0]), rtol=0, atol=1e-6)
    torch.testing.assert_close(later.position - front.position, torch.tensor([1.2, 0, 0]), rtol=0, atol=1e-5)
    # Half a frame behind the stamp the car is half a meter on; the other return is nearer than 1.5 m.
    world = log.sweeps[0].points + log.dataset_from_world[:3, 3].float()
    torch.testing.assert_close(world, torch.tensor([[11.5, 0, 0.9]]), rtol=0, atol=1e-5)
    assert log.seconds[1] == pytest.approx(0.12)
    assert [track.class_name for track in log.tracks] == ["car"]


def test_an_image_without_a_camera_in_the_window(root, written):
    folder, content = written
    for frame in content["frames"][:2]:
        del frame["images"]["left"]
    write_json(folder, content)
    with pytest.raises(ValueError, match="frames 0 to 1 have no image of left"):
        RigJsonReader(root=folder, cameras=["left"], last_frame=1).read()


def test_two_objects_of_one_name_are_refused_and_two_names_of_one_case_are_kept(written):
    folder, content = written
    other = content["boxes"][0] | {"name": content["boxes"][0]["name"].upper()}
    write_json(folder, content | {"boxes": [*content["boxes"], other]})
    assert len(RigJsonReader(root=folder).read().tracks) == 2
    write_json(folder, content | {"boxes": content["boxes"] * 2})
    with pytest.raises(LogError, match="two objects are named"):
        RigJsonReader(root=folder).read()


@pytest.mark.parametrize("mounted", [True, False])
def test_points_at_the_sensor_are_dropped_with_their_count(mounted, written):
    folder, content = written
    expected = RigJsonReader(root=folder).read().sweeps[1].points
    for frame in range(4):
        path = folder / f"lidar/{frame:03d}.npy"
        rows = np.load(path)
        if mounted:
            np.save(path, np.concatenate((rows, np.zeros((5, 4)), [[0.0, 5e-4, 0, 0]], [[0, 0.02, 0, 0]])))
        else:
            np.save(path, np.concatenate((PLAN.world_points(frame), np.zeros((6, 3)))))
    if not mounted:
        write_json(folder, content | {"lidar": {}})
    log = RigJsonReader(root=folder).read()
    assert len(log.sweeps[1].points) == len(expected) + mounted
    (note,) = [note for note in log.notes if "at the sensor itself" in note]
    assert note.startswith("points at the sensor itself are no returns and are dropped, such as 6 of")


def test_missing_images_are_left_out(written):
    folder, _ = written
    for name in ("front/001", "left/001", "left/002"):
        (folder / f"{name}.png").unlink()
    with pytest.raises(LogError, match="missing=skip"):
        RigJsonReader(root=folder).read()
    log = RigJsonReader(root=folder, missing="skip").read()
    assert [view.indices for view in log.views] == [(0, 0), (0, 1), (1, 0), (2, 0), (2, 1)]
    assert log.stamps[1] == PLAN.image_stamp(2, PLAN.cameras[0])
    assert "3 of 8 listed images lack files and are left out (data.log.missing=skip)" in log.notes


EXAMPLES = Path(__file__).parents[3] / "examples"

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
