"""Broken tables and points: one clear error that names the file, or a counted note."""

import json
import math
import re
from copy import deepcopy

import numpy as np
import pytest

from sparsestreet.data.problems import LogError
from sparsestreet.data.rig_json import RigJsonReader
from sparsestreet.data.rig_json.reader import read_rows
from tests.data.plan import Plan
from tests.data.rig_json.write import write_json

PLAN = Plan()


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
    "a lens unknown": (lens_with(model="mirror"), "cameras.front.lens.model is 'mirror', a lens that is not known"),
    "a number of another lens": (lens_with(k1=0.1), "cameras.front.lens has 'k1', which nothing reads"),
    "a focal length is missing": (lens_with(fx=None), "cameras.front.lens has no 'fx'"),
    "a focal length of 0": (lens_with(fx=0), "cameras.front.lens is no lens: the focal lengths"),
    "another first pixel": (lens_with(first_pixel=1), "first_pixel is where the first pixel's center lies, 0 or 0.5"),
    "a lens folds": (camera_with(lens=FISHEYE | {"k1": -3}), "folds back"),
    "a mount that is no rotation": (camera_with(vehicle_from_camera=turned([2, 0, 0, 0])), "is no unit quaternion"),
    "a mount mirrored": (camera_with(vehicle_from_camera=np.diag([1.0, 1, -1, 1]).tolist()), "is no rigid transform"),
    "no mount": (camera_with(vehicle_from_camera=None), r"frames\[0\].images.front has no pose"),
    "a shutter without a side": (camera_with(shutter={"readout": 0.01}), "cameras.front.shutter has no 'first'"),
    "a shutter from nowhere": (camera_with(shutter={"readout": 0.01, "first": "up"}), "'up', no side of an image"),
    "a readout of milliseconds": (
        camera_with(shutter={"readout": 33, "first": "top"}),
        "33 s, longer than any",
    ),
    "no exposure": (camera_with(exposure=0), "cameras.front.exposure must be positive"),
    "a decimal stamp": (frame_with(stamp=1.5), "stamp must be a whole number"),
    "no stamp": (frame_with(stamp=None), r"frames\[2\].images.front has a stamp, but its frame has none"),
    "stamps that go back": (frame_with(stamp=5), r"frames\[2\].stamp is out of order"),
    "no vehicle": (frame_with(world_from_vehicle=None), r"frames\[2\].images.front has no pose"),
    "a vehicle far away": (frame_with(world_from_vehicle=FAR), "poses span"),
    "a camera unknown": (frame_with(images={"right": "a.png"}), "is of a camera that is not described"),
    "an image outside": (image_with(file="../a.png"), "which is no file below the folder of rig.json"),
    "an image long ago": (image_with(stamp=5), r"frames\[2\].images.left has no pose: .* instants lie up to"),
    "a sweep missing": (frame_with(lidar="none.bin"), "none.bin: the file is missing"),
    "columns without z": (lambda c: c["lidar"].update(columns=["x", "y"]), "lidar.columns does not name x, y, z"),
    "a column twice": (lambda c: c["lidar"].update(columns=["x", "y", "z", "x"]), "names a column twice"),
    "no size": (box_with(size=None), r"boxes\[0\] has no 'size'"),
    "a size of 0": (box_with(size=[4, 0, 1]), "has a box of"),
    "no places": (box_with(at=[]), r"boxes\[0\].at must name at least one frame"),
    "a frame that is not there": (place_with(frame=9), r"frame must be a whole number from 0 to 3, it is 9"),
    "a frame twice": (place_with(frame=0), r"boxes\[0\].at must name at least one frame, in order, each once"),
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
    "absurd": (
        lambda path: path.write_bytes(re.sub(rb"\(\d+, 4\)", b"(9**9,4)", path.read_bytes(), count=1)),
        "the file is no array",
    ),
    "huge": (
        lambda path: path.write_bytes(re.sub(rb"\(\d+, 4\), } {8}", b"(99999999999, 4), }", path.read_bytes())),
        "the file is no array",
    ),
    "in rows of 5": (lambda path: np.save(path, np.zeros((3, 5))), "not numbers in rows of 4"),
    "of NaN": (lambda path: np.save(path, np.array([[0, 1, 2, math.nan]])), "1 of 1 points are NaN"),
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
            points, _, _ = read_rows(path, ("time", "x", "y", "z"))
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
