"""Each way to break a log is found, names its file, and stops the reader; all are found at once."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.drivestudio.layout import find_layout
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from tests.data.drivestudio.folders import (
    HEIGHT,
    WIDTH,
    make_nuscenes,
    make_waymo,
    write_image,
    write_json,
    write_lines,
    write_matrix,
    write_rows,
)

pytestmark = pytest.mark.lengthy

INFO = "instances/instances_info.json"


def remove(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


def edit_matrix(name: str, edit: Callable[[np.ndarray], None]) -> Callable[[Path], None]:
    def corrupt(root: Path) -> None:
        matrix = np.loadtxt(root / name)
        edit(matrix)
        write_matrix(root / name, matrix)

    return corrupt


def put(row: int, column: int, value: float) -> Callable[[np.ndarray], None]:
    return lambda matrix: matrix.__setitem__((row, column), value)


def mirror(matrix: np.ndarray) -> None:
    matrix[:3, 0] *= -1


def intrinsics(numbers: list[float]) -> Callable[[Path], None]:
    return lambda root: write_lines(root / "intrinsics/1.txt", numbers)


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda root: (root / name).write_text(content)


def truncate(name: str, size: int) -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:size])


def empty(folder: str) -> Callable[[Path], object]:
    return lambda root: [path.unlink() for path in (root / folder).iterdir()]


def image(name: str, height: int, width: int) -> Callable[[Path], None]:
    shape = (height, width, 3) if name.endswith("jpg") else (height, width)
    return lambda root: write_image(root / name, np.zeros(shape, np.uint8))


def points(value: float) -> Callable[[Path], None]:
    return lambda root: write_rows(root / "lidar/001.bin", np.array([[1.0, 2, 3, 0], [1, value, 3, 0]]))


def boxes(**columns: object) -> Callable[[Path], None]:
    """Replace columns of the one object's annotations."""

    def corrupt(root: Path) -> None:
        info = json.loads((root / INFO).read_text())
        info["0"]["frame_annotations"].update(columns)
        write_json(root / INFO, info)

    return corrupt


CORRUPTIONS = {
    "missing image": (remove("images/001_1.jpg"), "images/001_1.jpg", "missing"),
    "no images": (empty("images"), "images", "no TTT_C.jpg"),
    "missing pose": (remove("extrinsics/002_0.txt"), "extrinsics/002_0.txt", "missing"),
    "missing lidar pose": (remove("lidar_pose/001.txt"), "lidar_pose/001.txt", "missing"),
    "missing sweep": (remove("lidar/001.bin"), "lidar/001.bin", "missing"),
    "missing intrinsics": (remove("intrinsics/1.txt"), "intrinsics/1.txt", "missing"),
    "missing boxes": (remove(INFO), INFO, "missing"),
    "some sky masks": (remove("sky_masks/000_1.png"), "sky_masks/000_1.png", "missing"),
    "some human masks": (remove("dynamic_masks/human/000_1.png"), "dynamic_masks/human/000_1.png", "missing"),
    "small mask of the car": (
        lambda root: write_image(root / "ego_masks/0.png", np.zeros((3, 4), np.uint8)),
        "ego_masks/0.png",
        "the mask is 4x3",
    ),
    "pose of 3x4": (text("lidar_pose/000.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n"), "lidar_pose/000.txt", "4x4"),
    "ragged pose": (text("lidar_pose/000.txt", "1 0 0 0\n0 1\n"), "lidar_pose/000.txt", "no table"),
    "words for a pose": (text("lidar_pose/000.txt", "a b\nc d\n"), "lidar_pose/000.txt", "no table"),
    "mirrored pose": (edit_matrix("extrinsics/001_0.txt", mirror), "extrinsics/001_0.txt", "rigid"),
    "stray pose": (edit_matrix("extrinsics/001_1.txt", put(1, 3, 2.5e4)), "extrinsics/001_1.txt", "25.0 km"),
    "other image size": (image("images/001_0.jpg", HEIGHT, WIDTH + 1), "images/001_0.jpg", f"{WIDTH + 1}x{HEIGHT}"),
    "other mask size": (image("sky_masks/001_0.png", 12, 20), "sky_masks/001_0.png", "20x12"),
    "cut image": (truncate("images/001_0.jpg", -20), "images/001_0.jpg", "decoded"),
    "eight intrinsics": (intrinsics([40.0, 40, 20, 12, 0, 0, 0, 0]), "intrinsics/1.txt", "9 numbers"),
    "negative focal length": (intrinsics([-40.0, 40, 20, 12, 0, 0, 0, 0, 0]), "intrinsics/1.txt", "positive"),
    "lens without inverse": (intrinsics([40.0, 40, 20, 12, 0, 0, 1, 1, 0]), "intrinsics/1.txt", "no inverse"),
    "half a lidar row": (truncate("lidar/001.bin", 24), "lidar/001.bin", "24 bytes"),
    "NaN lidar point": (points(np.nan), "lidar/001.bin", "1 of 2 points"),
    "broken JSON": (text(INFO, '{"0": '), INFO, "no JSON"),
    "list for JSON": (text(INFO, "[]"), INFO, "list"),
    "object without boxes": (text(INFO, '{"0": {"class_name": "Vehicle"}}'), INFO, "cannot be read"),
    "object without frames": (boxes(frame_idx=[], obj_to_world=[], box_size=[]), INFO, "no frames"),
    "fewer boxes than frames": (boxes(box_size=[[4, 2, 1.5]] * 2), INFO, "3 frames"),
    "ragged boxes": (boxes(box_size=[[4, 2, 1.5], [4, 2], [4, 2, 1.5]]), INFO, "cannot be read"),
    "negative box": (boxes(box_size=[[4, -2, 1.5]] * 3), INFO, "-2.0"),
    "infinite box": (boxes(box_size=[[4, np.inf, 1.5]] * 3), INFO, "box of"),
    "unsorted frames": (boxes(frame_idx=[0, 2, 1]), INFO, "increasing"),
    "frame behind the end": (boxes(frame_idx=[0, 1, 3]), INFO, "ends at 2"),
    "scaled box pose": (boxes(obj_to_world=[np.diag([2.0, 1, 1, 1]).tolist()] * 3), INFO, "rigid"),
    "too few stamps": (text("timestamps.txt", "0.0\n0.1\n"), "timestamps.txt", "3 stamps, got 2"),
    "a folder for a clock": (
        lambda root: (root / "timestamps.txt").rename(root / "old.txt") and (root / "timestamps.txt").mkdir(),
        "timestamps.txt",
        "cannot be read",
    ),
    "unknown object": (text("instances/frame_instances.json", '{"0": [7]}'), "instances/frame_instances.json", "7"),
    "fine masks for one class": (
        lambda root: shutil.copytree(root / "dynamic_masks/human", root / "fine_dynamic_masks/human"),
        "fine_dynamic_masks/vehicle/000_0.png",
        "6 files of the folder are missing: 000_0.png, 000_1.png, 001_0.png, 001_1.png, 002_0.png, ...",
    ),
}


@pytest.mark.parametrize("make", [make_nuscenes, make_waymo])
def test_a_sound_log_has_no_problems(make, tmp_path):
    assert DriveStudioReader(make(tmp_path)).check() == []


@pytest.mark.parametrize("lidar", [True, False])
@pytest.mark.parametrize(
    ("make", "name", "of_lidar"),
    [
        (make_nuscenes, "images/004_1.jpg", False),
        (make_nuscenes, "extrinsics/004_1.txt", False),
        (make_nuscenes, "lidar_pose/004.txt", True),
        (make_nuscenes, "lidar/004.bin", True),
        (make_waymo, "images/004_1.jpg", False),
        (make_waymo, "ego_pose/004.txt", False),
        (make_waymo, "lidar/004.bin", True),
    ],
)
def test_a_log_has_as_many_frames_as_its_longest_kind_of_file(make, name, of_lidar, lidar, tmp_path):
    root = make(tmp_path)
    (root / name).touch()
    layout = find_layout(root, lidar=lidar)
    assert layout.num_frames_on_disk == len(layout.frames) == (3 if of_lidar and not lidar else 5)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_the_broken_file_is_named_and_the_reader_refuses_it(name, tmp_path):
    corrupt, file, fragment = CORRUPTIONS[name]
    corrupt(make_nuscenes(tmp_path))
    problems = DriveStudioReader(tmp_path).check()
    assert len(problems) == 1
    assert file in [problem.path.relative_to(tmp_path).as_posix() for problem in problems]
    assert fragment in " ".join(problem.message for problem in problems)
    assert all(problem.remedy for problem in problems)
    with pytest.raises(LogError, match=file) as caught:
        _use(DriveStudioReader(tmp_path).read())
    assert list(caught.value.problems) == problems


def _use(log: DrivingLog) -> None:
    """What every training does before its first step: only broken points and pixels can show there."""
    assert log.radius > 0


def test_pixels_that_break_later_are_reported_with_all_others_when_they_are_asked_for(tmp_path):
    log = DriveStudioReader(make_nuscenes(tmp_path)).read()
    for name in ("images/001_0.jpg", "images/002_1.jpg"):
        truncate(name, -20)(tmp_path)
    assert log.frames[0].image.shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(LogError) as caught:
        log.frames[2]
    assert list(caught.value.problems) == DriveStudioReader(tmp_path).check()
    assert len(caught.value.problems) == 2
    with pytest.raises(LogError, match="2 problems"):
        log.sweeps[2]


def test_a_lens_with_an_inverse_is_no_problem_and_needs_sound_images(tmp_path):
    intrinsics([40.0, 40, 20, 12, -0.3, 0.1, 0.001, 0, 0])(make_nuscenes(tmp_path))
    assert DriveStudioReader(tmp_path).check() == []
    truncate("images/000_1.jpg", 5)(tmp_path)
    (problem,) = DriveStudioReader(tmp_path).check()
    assert problem.path == tmp_path / "images/000_1.jpg"


def test_bytes_behind_the_end_of_an_image_do_no_harm(tmp_path):
    make_nuscenes(tmp_path)
    for name in ("images/001_0.jpg", "sky_masks/001_0.png"):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + b"padding")
    assert DriveStudioReader(tmp_path).check() == []
    assert DriveStudioReader(tmp_path).read().frames[2].sky.any()


def test_all_problems_are_found_at_once(tmp_path):
    make_nuscenes(tmp_path)
    names = ["missing image", "mirrored pose", "other mask size", "NaN lidar point", "negative box"]
    for name in names:
        CORRUPTIONS[name][0](tmp_path)
    found = {problem.path.relative_to(tmp_path).as_posix() for problem in DriveStudioReader(tmp_path).check()}
    assert found == {CORRUPTIONS[name][1] for name in names}
    with pytest.raises(LogError, match="4 problems"):  # points are only read once the rest is sound
        DriveStudioReader(tmp_path).read()


def test_every_object_at_fault_is_reported(tmp_path):
    make_nuscenes(tmp_path)
    info = json.loads((tmp_path / INFO).read_text())
    write_json(tmp_path / INFO, {key: {"class_name": "Vehicle"} for key in ("0", "1", "2")} | {"3": info["0"]})
    messages = [problem.message for problem in DriveStudioReader(tmp_path).check()]
    assert [message.split(" cannot")[0] for message in messages] == ["object 0", "object 1", "object 2"]


def test_the_waymo_flavor_is_checked_by_its_own_files(tmp_path):
    make_waymo(tmp_path)
    edit_matrix("ego_pose/001.txt", mirror)(tmp_path)
    edit_matrix("extrinsics/1.txt", put(0, 0, 1.2))(tmp_path)
    remove("ego_pose/002.txt")(tmp_path)
    write_rows(tmp_path / "lidar/000.bin", np.ones((3, 4)))  # rows of the other flavor
    found = {problem.path.relative_to(tmp_path).as_posix() for problem in DriveStudioReader(tmp_path).check()}
    assert found == {"ego_pose/001.txt", "extrinsics/1.txt", "ego_pose/002.txt", "lidar/000.bin"}


def test_what_is_not_read_is_not_checked(tmp_path):
    make_nuscenes(tmp_path)
    CORRUPTIONS["cut image"][0](tmp_path)
    CORRUPTIONS["negative focal length"][0](tmp_path)
    assert DriveStudioReader(tmp_path, cameras=[0], first_frame=2).check() == []


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ("nowhere", "nothing is there"),
        ("a.txt", "this is a file"),
        ("empty", "no images/"),
        ("", "it holds the scenes 007, 012"),
    ],
)
def test_what_is_no_scene_is_told_apart(named, words, tmp_path):
    for scene in ("007", "012"):
        make_nuscenes(tmp_path / scene)
    (tmp_path / "a.txt").touch()
    (tmp_path / "empty").mkdir()
    (problem,) = DriveStudioReader(tmp_path / named).check()
    assert problem.path == tmp_path / named
    assert words in problem.message
    assert ("007" in problem.remedy) == (named == "")
    assert ("data=auto" in problem.remedy) == (named == "empty")


@pytest.mark.parametrize(
    "choice",
    [{"cameras": [2]}, {"cameras": []}, {"cameras": [0, 0]}, {"first_frame": 3}, {"last_frame": 3}, {"last_frame": -2}],
)
def test_a_choice_the_log_cannot_give_is_an_error(choice, tmp_path):
    with pytest.raises(ValueError, match="log's"):
        DriveStudioReader(make_nuscenes(tmp_path), **choice).read()


@pytest.mark.parametrize("make", [make_nuscenes, make_waymo])
@pytest.mark.parametrize("gone", ["images/002_0.jpg", "lidar/002.bin"])
def test_a_frame_that_lacks_a_file_can_be_left_out(make, gone, tmp_path):
    whole = DriveStudioReader(make(tmp_path, frames=5)).read()
    (tmp_path / gone).unlink()
    (problem,) = DriveStudioReader(tmp_path).check()
    assert "data.log.missing=skip" in problem.remedy
    reader = DriveStudioReader(tmp_path, missing="skip", first_frame=1)
    assert reader.check() == []
    log = reader.read()
    assert "1 of 4 frames lack files and are left out (data.log.missing=skip)" in log.notes
    assert list(log.stamps.values()) == [whole.stamps[frame] for frame in (1, 3, 4)]
    assert torch.equal(log.frames[2].image, whole.frames[6].image)
    assert log.tracks[0].frames.tolist() == [0, 1, 2]
    lost = log.tracks[0].world_from_object[1, :3, 3] + log.dataset_from_world[:3, 3]
    assert torch.equal(lost, whole.tracks[0].world_from_object[3, :3, 3] + whole.dataset_from_world[:3, 3])
    for path in tmp_path.glob("images/*_1.jpg"):
        path.unlink()
    with pytest.raises(LogError, match="are missing"):
        reader.read()


@pytest.mark.parametrize("make", [make_nuscenes, make_waymo])
def test_points_at_the_sensor_are_dropped_with_their_count(make, tmp_path):
    expected = DriveStudioReader(make(tmp_path)).read().sweeps[1].points
    path = tmp_path / "lidar/001.bin"
    columns = 14 if make is make_waymo else 4
    rows = np.zeros((3, columns), np.float32)
    rows[1:, :6] = 0.25  # of Waymo's rows, the ray's origin and its end
    path.write_bytes(path.read_bytes() + rows.tobytes())
    log = DriveStudioReader(tmp_path).read()
    kept = 0 if make is make_waymo else 2
    assert len(log.sweeps[1].points) == len(expected) + kept
    (note,) = [note for note in log.notes if "at the sensor itself" in note]
    assert f"{3 - kept} of {len(expected) + 3} in 001.bin" in note


def test_an_object_that_stands_twice_is_no_json(tmp_path):
    path = make_nuscenes(tmp_path) / "instances/instances_info.json"
    (entry,) = json.loads(path.read_text()).values()
    path.write_text(f'{{"0": {json.dumps(entry)}, "0": {json.dumps(entry)}}}')
    (problem,) = DriveStudioReader(tmp_path).check()
    assert "names '0' twice" in problem.message


FLAVORS = pytest.mark.parametrize("make", [make_nuscenes, make_waymo])


def hash_of(root: Path, **choice: Any) -> str:
    return DriveStudioReader(root, **choice).data_hash()


def flip(path: Path, place: int) -> None:
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


READ = (
    "images/001_1.jpg", "sky_masks/002_0.png", "dynamic_masks/human/000_1.png", "lidar/002.bin", "intrinsics/1.txt",
    "instances/instances_info.json", "timestamps.txt",
)  # fmt: skip


@pytest.mark.parametrize(("make", "pose"), [(make_nuscenes, "extrinsics/001_0.txt"), (make_waymo, "ego_pose/001.txt")])
def test_every_kind_of_file_that_is_read_counts(make, pose, tmp_path):
    hashes = {hash_of(make(tmp_path))}
    for name in (*READ, pose):
        flip(tmp_path / name, -3)
        hashes.add(hash_of(tmp_path))
    assert len(hashes) == len(READ) + 2


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
