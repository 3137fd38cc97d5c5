"""The hash of a folder: of the frames and cameras that are read, in another place the same, and cheap."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.reader import LogFiles, hash_files
from tests.data.drivestudio.folders import make_nuscenes, make_waymo

FLAVORS = pytest.mark.parametrize("make", [make_nuscenes, make_waymo])


def hash_of(root: Path, **choice: Any) -> str:
    return DriveStudioReader(root, **choice).data_hash()


def flip(path: Path, place: int = 0) -> None:
    """Another byte, at the same size."""
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


@FLAVORS
def test_a_copy_has_the_same_hash_and_so_has_one_with_files_that_nobody_reads(make, tmp_path):
    before = hash_of(make(tmp_path / "log"))
    shutil.copytree(tmp_path / "log", tmp_path / "copy")
    (tmp_path / "copy/README.md").write_text("notes")
    (tmp_path / "copy/depth").mkdir()
    (tmp_path / "copy/depth/000_0.npz").write_bytes(b"truth")
    assert hash_of(tmp_path / "copy") == before


READ = [
    "images/001_1.jpg", "sky_masks/002_0.png", "dynamic_masks/human/000_1.png", "lidar/002.bin", "intrinsics/1.txt",
    "instances/instances_info.json", "timestamps.txt",
]  # fmt: skip


@FLAVORS
@pytest.mark.parametrize("name", READ)
def test_every_kind_of_file_that_is_read_counts(make, name, tmp_path):
    before = hash_of(make(tmp_path))
    flip(tmp_path / name, -3)
    assert hash_of(tmp_path) != before


def test_poses_of_either_flavor_count(tmp_path):
    for make, name in ((make_nuscenes, "extrinsics/001_0.txt"), (make_waymo, "ego_pose/001.txt")):
        root = make(tmp_path / make.__name__)
        before = hash_of(root)
        flip(root / name, -3)
        assert hash_of(root) != before


@pytest.mark.parametrize(
    ("choice", "change"),
    [
        ({"cameras": [0]}, lambda root: flip(root / "images/001_1.jpg", -3)),
        ({"last_frame": 1}, lambda root: flip(root / "images/002_0.jpg", -3)),
        ({"first_frame": 1}, lambda root: (root / "lidar/000.bin").write_bytes(b"")),
    ],
)
def test_frames_and_cameras_that_are_not_read_do_not_count(choice: dict, change: Callable, tmp_path):
    make_nuscenes(tmp_path)
    part, whole = hash_of(tmp_path, **choice), hash_of(tmp_path)
    assert part != whole
    change(tmp_path)
    assert hash_of(tmp_path, **choice) == part
    assert hash_of(tmp_path) != whole


@FLAVORS
def test_a_run_without_lidar_bodies_or_resolution_is_of_the_same_log(make, tmp_path):
    """A report compares such runs, and would say that their data differ."""
    before = hash_of(make(tmp_path))
    assert hash_of(tmp_path, lidar=False, bodies=False, width=20) == before


def test_of_boxes_and_poses_every_byte_counts(tmp_path):
    """Also of more than are read at a time."""
    boxes = tmp_path / "boxes.json"
    boxes.write_bytes(bytes(2_500_000))
    before = hash_files(tmp_path, LogFiles(described=[boxes]))
    flip(boxes, 1_250_000)
    assert hash_files(tmp_path, LogFiles(described=[boxes])) != before


def test_large_files_are_not_read(tmp_path, monkeypatch):
    """A sweep of 100 MB, which on the disk is a hole."""
    make_nuscenes(tmp_path)
    with (tmp_path / "lidar/001.bin").open("wb") as file:
        file.truncate(100_000_000)
    taken = []
    opened = Path.open

    def counted(path, *how):
        file = opened(path, *how)
        read = file.read
        monkeypatch.setattr(file, "read", lambda *size: taken.append(read(*size)) or taken[-1], raising=False)
        return file

    monkeypatch.setattr(Path, "open", counted)
    hash_of(tmp_path)
    assert 0 < sum(map(len, taken)) < 100_000
