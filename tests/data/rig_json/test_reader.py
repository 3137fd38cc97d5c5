"""A drive described by hand is read as it was planned."""

import json
import math
import re
from copy import deepcopy
from dataclasses import MISSING, fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from sparsestreet.data.recording import Recording
from sparsestreet.data.rig_json import RigJsonReader
from sparsestreet.data.rig_json.sweeps import read_rows
from sparsestreet.data.rig_json.values import LENSES
from tests.data.plan import Plan
from tests.data.rig_json.write import in_lidar, write_json, write_rig
from tests.shared import made_once
from tests.typed import there

PLAN = Plan()
CHORD = 0.015
"""Meters between the plan's circle (r = 50 m) and a line between two of its frames, half a frame behind them too."""
PAGE = Path(__file__).parents[3] / "docs" / "datasets" / "rig_json.md"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return made_once(tmp_path_factory, "rig_json", lambda folder: write_rig(folder, PLAN))


@pytest.fixture(scope="module")
def recording(root) -> Recording:
    return RigJsonReader(root=root).recording()


@pytest.fixture(scope="module")
def log(root) -> DrivingLog:
    return RigJsonReader(root=root).read()


@pytest.fixture
def written(tmp_path):
    """A folder and its JSON's content, to be changed."""
    return tmp_path, write_rig(tmp_path, PLAN)


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
    np.column_stack((points, np.zeros(len(points)))).astype("<f4").tofile(folder / "lidar/000.bin")
    content["frames"][0]["lidar"] = {"file": "lidar/000.bin"}
    for frame in content["frames"][1:]:
        del frame["lidar"]
    write_json(folder, content)
    sweeps = there(RigJsonReader(root=folder).recording().sweeps)
    far = np.linalg.norm(points, axis=1) >= 10
    assert 0 < far.sum() < len(far)
    np.testing.assert_allclose(sweeps[0].read().numpy(), PLAN.world_points(0)[far], atol=1e-5)  # float32 of 45 m
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
    found = RigJsonReader(root=folder, min_lens_shift=0.0).recording().rig[0]
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


def camera_with(**values: object):
    return lambda content: content["cameras"]["front"].update(values)


def lens_with(**values: object):
    return lambda content: content["cameras"]["front"]["lens"].update(values)


def frame_with(**values: object):
    return lambda content: content["frames"][2].update(values)


def image_with(**values: object):
    return lambda content: content["frames"][2]["images"]["left"].update(values)


def box_with(**values: object):
    return lambda content: content["boxes"][0].update(values)


def place_with(**values: object):
    return lambda content: content["boxes"][0]["at"][1].update(values)


def top_with(**values: object):
    return lambda content: content.update(values)


def turned(quaternion: list[float]) -> dict[str, list[float]]:
    return {"translation": [0, 0, 0], "rotation": quaternion}


FISHEYE = {"model": "fisheye", "fx": 30, "fy": 30, "cx": 16, "cy": 12}
FAR = {"translation": [9e7, 0, 0], "rotation": [1, 0, 0, 0]}
DAMAGE = {
    "no cameras": (top_with(cameras=None), "the file has no 'cameras'"),
    "cameras of none": (top_with(cameras={}), "cameras is empty"),
    "no frames": (top_with(frames=[]), "frames has no image"),
    "a slip at the top": (top_with(boxs=[]), "the file has 'boxs', which nothing reads"),
    "a slip in a camera": (camera_with(wdith=3), "cameras.front has 'wdith', which nothing reads"),
    "a slip in a frame": (frame_with(image={}), r"frames\[2\] has 'image', which nothing reads"),
    "a slip in a box": (box_with(clas="car"), r"boxes\[0\] has 'clas', which nothing reads"),
    "a camera named as a path": (lambda c: c["cameras"].update({"a/b": {}}), "cameras.a/b is no name of a camera"),
    "no width": (camera_with(width=0), "cameras.front.width must be a whole number from 1 to 100000, it is 0"),
    "another size": (camera_with(width=64), "the image is 32x24, camera front is calibrated for 64x24"),
    "no lens": (camera_with(lens=None), "cameras.front has no 'lens'"),
    "a lens unknown": (lens_with(model="mirror"), "cameras.front.lens.model is 'mirror', a lens that is not known"),
    "a lens's model a list": (lens_with(model=["pinhole"]), "lens.model is a list of 1, not a text"),
    "a number of another lens": (lens_with(k1=0.1), "cameras.front.lens has 'k1', which nothing reads"),
    "a focal length is missing": (lens_with(fx=None), "cameras.front.lens has no 'fx'"),
    "a focal length of 0": (lens_with(fx=0), "cameras.front.lens is no lens: the focal lengths"),
    "a focal length in words": (lens_with(fx="30"), "lens.fx is '30', not a number"),
    "another first pixel": (lens_with(first_pixel=1), "first_pixel is where the first pixel's center lies, 0 or 0.5"),
    "a lens folds": (camera_with(lens=FISHEYE | {"k1": -3}), "folds back"),
    "an f-theta of words": (camera_with(lens={"model": "f_theta", "cx": 1, "cy": 1, "polynomial": "1"}), "not a list"),
    "a mount that is no rotation": (camera_with(vehicle_from_camera=turned([2, 0, 0, 0])), "is no unit quaternion"),
    "a mount of 3 numbers": (camera_with(vehicle_from_camera=turned([1, 0, 0])), "has 3 numbers, not 4"),
    "a mount mirrored": (camera_with(vehicle_from_camera=np.diag([1.0, 1, -1, 1]).tolist()), "is no rigid transform"),
    "no mount": (camera_with(vehicle_from_camera=None), r"frames\[0\].images.front has no pose"),
    "a shutter without a side": (camera_with(shutter={"readout": 0.01}), "cameras.front.shutter has no 'first'"),
    "a shutter from nowhere": (camera_with(shutter={"readout": 0.01, "first": "up"}), "'up', no side of an image"),
    "a readout of milliseconds": (
        camera_with(shutter={"readout": 33, "first": "top"}),
        "33 s, longer than any",
    ),
    "no exposure": (camera_with(exposure=0), "cameras.front.exposure must be positive"),
    "no ego mask": (camera_with(ego_mask="none.png"), "none.png: the file is missing"),
    "a decimal stamp": (frame_with(stamp=1.5), "stamp must be a whole number"),
    "a huge stamp": (frame_with(stamp=10**30), "stamp must be a whole number"),
    "no stamp": (frame_with(stamp=None), r"frames\[2\].images.front has a stamp, but its frame has none"),
    "stamps that go back": (frame_with(stamp=5), r"frames\[2\].stamp is out of order"),
    "no vehicle": (frame_with(world_from_vehicle=None), r"frames\[2\].images.front has no pose"),
    "a vehicle far away": (frame_with(world_from_vehicle=FAR), "poses span"),
    "a camera unknown": (frame_with(images={"right": "a.png"}), "is of a camera that is not described"),
    "an image missing": (image_with(file="left/none.png"), "none.png: the file is missing"),
    "an image outside": (image_with(file="../a.png"), "which is no file below the folder of rig.json"),
    "an image long ago": (image_with(stamp=5), r"frames\[2\].images.left has no pose: .* instants lie up to"),
    "a sweep missing": (frame_with(lidar="none.bin"), "none.bin: the file is missing"),
    "columns without z": (lambda c: c["lidar"].update(columns=["x", "y"]), "lidar.columns does not name x, y, z"),
    "a column twice": (lambda c: c["lidar"].update(columns=["x", "y", "z", "x"]), "names a column twice"),
    "no class": (box_with(**{"class": None}), r"boxes\[0\] has no 'class'"),
    "no size": (box_with(size=None), r"boxes\[0\] has no 'size'"),
    "a size of 0": (box_with(size=[4, 0, 1]), "has a box of"),
    "no places": (box_with(at=[]), r"boxes\[0\].at must name at least one frame"),
    "a frame that is not there": (place_with(frame=9), r"frame must be a whole number from 0 to 3, it is 9"),
    "a frame twice": (place_with(frame=0), r"boxes\[0\].at must name at least one frame, in order, each once"),
    "a box without pose": (place_with(world_from_box=None), r"at\[1\] has no 'world_from_box'"),
    "some stamps": (place_with(stamp=None), r"boxes\[0\].at has a stamp in 3 of 4"),
}


@pytest.mark.parametrize(("change", "said"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damage_of_the_table_is_one_clear_error(change, said, root, tmp_path):
    for name in ("front", "left", "lidar"):
        (tmp_path / name).symlink_to(root / name)
    content = deepcopy(json.loads((root / "rig.json").read_text()))
    change(content)
    write_json(tmp_path, content)
    problems = RigJsonReader(root=tmp_path).check()
    assert problems
    assert len({problem.message for problem in problems}) == 1, problems
    with pytest.raises(LogError, match=said):
        raise LogError(problems)


POINTS = {
    "not numbers": (lambda path: np.save(path, np.array([["a"] * 4])), "not numbers in rows of 4"),
    "pickled": (lambda path: np.save(path, np.array([{}] * 4), allow_pickle=True), "the file is no array"),
    "no array": (lambda path: path.write_bytes(b"PK\3\4" + bytes(50)), "the file is no array"),
    "cut short": (lambda path: path.write_bytes(path.read_bytes()[:200]), "the file is no array"),
    "absurd": (
        lambda path: path.write_bytes(re.sub(rb"\(\d+, 4\)", b"(9**9,4)", path.read_bytes(), count=1)),
        "the file is no array",
    ),
    "huge": (
        lambda path: path.write_bytes(re.sub(rb"\(\d+, 4\), } {8}", b"(99999999999, 4), }", path.read_bytes())),
        "the file is no array",
    ),
    "deep": (lambda path: path.write_bytes(b"\x93NUMPY\1\0\xb8\x0b" + b"(" * 3000), "the file is no array"),
    "in rows of 5": (lambda path: np.save(path, np.zeros((3, 5))), "not numbers in rows of 4"),
    "of NaN": (lambda path: np.save(path, np.array([[0, 1, 2, math.nan]])), "1 of 1 points are NaN"),
    "far away": (lambda path: np.save(path, np.array([[0, 1, 2, 5e3]])), "1 of 1 points are NaN, infinite or more"),
    "times in nanoseconds": (lambda path: np.save(path, np.array([[5e7, 1, 2, 3]])), "times must lie within 1 s"),
    "times outside of the drive": (lambda path: np.save(path, np.array([[0.9, 1, 2, 3]])), "instants lie up to"),
}


@pytest.mark.parametrize(("damage", "said"), POINTS.values(), ids=POINTS.keys())
def test_damage_of_points_is_one_clear_error(damage, said, written):
    folder, _ = written
    damage(folder / "lidar/002.npy")
    reader = RigJsonReader(root=folder)
    log = reader.read()  # points are not decoded when a log is opened
    (problem,) = reader.check()
    assert problem.path.name == "002.npy"
    with pytest.raises(LogError, match=said):
        log.sweeps[2]


@pytest.mark.slow
def test_mutated_arrays_are_read_or_refused(root, tmp_path):
    path, random, refused = tmp_path / "a.npy", np.random.default_rng(0), 0
    sound = (root / "lidar/000.npy").read_bytes()
    for _ in range(200):
        content = bytearray(sound)
        for place in random.integers(0, 128, 1):
            content[place] = random.integers(256)
        path.write_bytes(content)
        try:
            points, _ = read_rows(path, ("time", "x", "y", "z"))
            assert points.shape[1] == 3
        except LogError:
            refused += 1
    assert refused > 50


def test_a_bin_of_part_rows(written):
    folder, content = written
    (folder / "lidar/000.bin").write_bytes(bytes(20))
    content["frames"][0]["lidar"] = "lidar/000.bin"
    write_json(folder, content)
    with pytest.raises(LogError, match="20 bytes are no whole number of rows of 4 float32"):
        RigJsonReader(root=folder).read().sweeps[0]
    content["frames"][0]["lidar"] = "hood.las"
    (folder / "hood.las").write_bytes(b"")
    write_json(folder, content)
    with pytest.raises(LogError, match=r"points of the ending '\.las' are not read"):
        RigJsonReader(root=folder).read().sweeps[0]


def test_an_image_without_a_camera_in_the_window(root, written):
    folder, content = written
    for frame in content["frames"][:2]:
        del frame["images"]["left"]
    write_json(folder, content)
    with pytest.raises(ValueError, match="frames 0 to 1 have no image of left"):
        RigJsonReader(root=folder, cameras=["left"], last_frame=1).read()
