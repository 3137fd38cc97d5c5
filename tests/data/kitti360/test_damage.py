"""Broken sequences: one clear error that names the file, or a counted note."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.kitti360 import Kitti360Reader
from sparsestreet.data.kitti360.files import read_boxes
from sparsestreet.data.problems import LogError
from tests.data.damage import (
    LAUGHS,
    assert_found,
    cut,
    daily,
    gone,
    line,
    png,
    refusals,
    replaced,
    written,
)
from tests.data.kitti360.write import SEQUENCE, write_fisheye, write_kitti360
from tests.shared import made_once

MOUNTS, LIDAR = (f"calibration/calib_cam_to_{name}.txt" for name in ("pose", "velo"))
PERSPECTIVE = "calibration/perspective.txt"
FISHEYE = "calibration/image_02.yaml"
POSES, XML = f"data_poses/{SEQUENCE}/poses.txt", f"data_3d_bboxes/train/{SEQUENCE}.xml"
IMAGE, STAMPS = (f"data_2d_raw/{SEQUENCE}/image_00/{name}" for name in ("data_rect/0000000001.png", "timestamps.txt"))
SWEEP = f"data_3d_raw/{SEQUENCE}/velodyne_points/data/0000000001.bin"
LABELS = f"data_2d_semantics/train/{SEQUENCE}/image_00/semantic/0000000001.png"
HEAD = '<?xml version="1.0"?>'
DAMAGES = {
    "no mount of a camera": (MOUNTS, replaced("image_01", "image_10"), "no line 'image_01'"),
    "a mount of 13 numbers": (MOUNTS, replaced("image_01: ", "image_01: 1 "), "has 13 numbers"),
    "a mount that scales": (MOUNTS, replaced("image_01: ", "image_01: 2 0 0 0 0 2 0 0 0 0 2 0\nx: "), "no rigid"),
    "no lidar mount": (LIDAR, gone, "missing"),
    "a short lidar mount": (LIDAR, written(b"1 0 0 0 0 1 0 0 0 0 1"), "the file has 11 numbers"),
    "a lidar mount that turns inside out": (LIDAR, written(b"-1 0 0 0 0 1 0 0 0 0 1 0"), "no rigid"),
    "half a pixel": (PERSPECTIVE, replaced("S_rect_01: 32.0", "S_rect_01: 32.5"), "no size of an image"),
    "another lens": (FISHEYE, replaced("model_type:MEI", "model_type:PINHOLE"), "the lens that is read is MEI"),
    "half a lens": (FISHEYE, replaced("gamma2:24.0", ""), "no line 'gamma2'"),
    "a lens of xi -2": (FISHEYE, replaced("xi:1.0", "xi:-2.0"), "larger than -1"),
    "a lens that folds": (FISHEYE, replaced("k1:0.0", "k1:-90.0"), "folds back"),
    "empty poses": (POSES, written(b"\n\n"), "holds no poses"),
    "a short pose": (POSES, line(1, "1 1 0 0 0 0 1 0 0 0 0 1"), "line 2 has 12 numbers"),
    "a pose of a word": (POSES, line(1, "one"), "no number"),
    "frames out of order": (POSES, line(3, "1 1 0 0 0 0 1 0 0 0 0 1 0"), "which does not follow frame 3"),
    "half a frame": (POSES, line(1, "1.5 1 0 0 0 0 1 0 0 0 0 1 0"), "is of frame 1.5"),
    "a pose that scales": (POSES, line(1, "1 2 0 0 4123 0 2 0 -2345 0 0 2 31"), "the pose of frame 1 is no rigid"),
    "a pose far away": (POSES, line(1, "1 1 0 0 9e6 0 1 0 0 0 0 1 0"), "poses span"),
    "no image": (IMAGE, gone, "the file is missing"),
    "an empty stamp": (STAMPS, line(3, ""), "line 4, of frame 3, is empty"),
    "a point far away": (SWEEP, lambda path: path.write_bytes(path.read_bytes() + 4 * b"\x00\x00\x00\x7f"), "1 of"),
    "torn labels": (LABELS, cut, "decoded"),
    "small labels": (LABELS, png(16, 12, "L"), "the image is 16x12"),
    "labels of colors": (LABELS, png(32, 24, "RGB"), "has the mode RGB"),
    "entities": (XML, replaced(HEAD, HEAD + LAUGHS), "EntitiesForbidden"),
    "no instance": (XML, replaced("<instanceId>7</instanceId>", ""), "no number"),
    "half a class": (XML, replaced("<semanticId>13", "<semanticId>13.5"), "no integers"),
    "no last row": (XML, replaced("0.0 0.0 0.0 1.0</data>", "0.0 0.0 0.0</data>"), "no 4x4 transform"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    def make(folder: Path) -> None:
        write_kitti360(folder)
        write_fisheye(folder)

    return made_once(tmp_path_factory, "kitti360_fisheye", make)


@pytest.mark.parametrize(
    "name", daily(DAMAGES, "a mount that scales", "frames out of order", "torn labels", "entities", "no last row")
)
def test_a_broken_file_is_named(name, whole, tmp_path):
    relative, damage, said = DAMAGES[name]
    root = tmp_path.resolve() / "root"
    shutil.copytree(whole, root)
    damage(root / relative)
    cameras = ["image_00", "image_01"] + (["image_02"] if relative == FISHEYE else [])
    assert_found(Kitti360Reader(root=root, sequence=3, cameras=cameras), root / relative, said)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        ("1 0 0 5 0 0 0 5 0 0 1 5 0 0 0 1", "scales by"),
        ("-1 0 0 5 0 1 0 5 0 0 1 5 0 0 0 1", "scales by"),
        ("1 0.5 0 5 0 1 0 5 0 0 1 5 0 0 0 1", "scales by"),
        ("500 0 0 5 0 1 0 5 0 0 1 5 0 0 0 1", "scales by"),
        ("nan 0 0 5 0 1 0 5 0 0 1 5 0 0 0 1", "NaN"),
    ],
    ids=["flat", "mirrored", "sheared", "huge", "nan"],
)
def test_a_cuboid_that_is_none_is_refused(tmp_path, matrix, said):
    keys = ("semanticId", "instanceId", "timestamp", "start_frame", "end_frame")
    fields = "".join(f"<{key}>{value}</{key}>" for key, value in zip(keys, (13, 1, -1, 0, 9), strict=True))
    path = tmp_path / "boxes.xml"
    path.write_text(f"<opencv_storage><a>{fields}<transform><data>{matrix}</data></transform></a></opencv_storage>")
    with pytest.raises(LogError, match=said):
        read_boxes(path, np.array([0]), np.zeros((1, 3)))


def test_whatever_is_not_there_is_said(whole, tmp_path):
    with pytest.raises(LogError, match="the sequence is not there; there are sequences 0003"):
        Kitti360Reader(root=whole, sequence=4).read()
    with pytest.raises(LogError, match="root must be the folder of data_2d_raw"):
        Kitti360Reader(root=tmp_path, sequence=4).read()
    for name in ("../3", "0003x", -1, ""):
        with pytest.raises(ValueError, match=r"is a number from 0 to 18, got .*; there are sequences 0003: set"):
            Kitti360Reader(root=whole, sequence=name).read()
    with pytest.raises(ValueError, match=r"cameras \['image_03'\] must be different ones"):
        Kitti360Reader(root=whole, sequence=3, cameras=["image_03"]).read()


def test_the_only_sequence_needs_no_number(whole, tmp_path):
    assert Kitti360Reader(root=whole).read().name == "2013_05_28_drive_0003"
    with pytest.raises(LogError, match="there is no sequence; root must be the folder of data_2d_raw"):
        Kitti360Reader(root=tmp_path).read()
    for number in (0, 18):
        (tmp_path / f"data_2d_raw/2013_05_28_drive_{number:04d}_sync").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"there are sequences 0000, 0018 in .*: name one"):
        Kitti360Reader(root=tmp_path).read()


@pytest.mark.slow
def test_nothing_but_problems_comes_of_random_bytes(whole, tmp_path):
    def read(path: Path) -> object:
        return read_boxes(path, np.array([0, 1, 3]), np.zeros((3, 3)))

    content = (whole / XML).read_bytes()
    assert 50 < refusals(read, tmp_path / "boxes.xml", content, count=200, seed=360) < 200
