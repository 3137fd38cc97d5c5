"""The hash of a log: the same log in another place, and what changes it."""

import ast
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from sparsestreet.data.drivestudio.annotations import role_of
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError, Problem
from sparsestreet.data.reader import LogFiles, LogReader, hash_files
from sparsestreet.data.synthetic import StreetReader, StreetSettings
from tests.data.toy_rig import ToyRigReader
from tests.typed import there

CONF = Path(__file__).parents[2] / "conf"
CLASSES = sorted(path.stem for path in (CONF / "data").glob("*.yaml"))


@dataclass(frozen=True)
class AnyFolder(LogReader):
    """Only its files are looked at."""

    root: Path

    @property
    def folder(self) -> Path:
        return self.root

    def check(self) -> list[Problem]:
        raise NotImplementedError

    def read(self) -> DrivingLog:
        raise NotImplementedError


@pytest.fixture
def log(tmp_path) -> Path:
    root = tmp_path / "log"
    (root / "images").mkdir(parents=True)
    (root / "poses.txt").write_text("1 0 0 0")
    (root / "images" / "0.bin").write_bytes(bytes(200_000))
    return root


def test_the_same_log_elsewhere_has_the_same_hash(log, tmp_path):
    before = AnyFolder(log).data_hash()
    assert len(before) == 12
    assert AnyFolder(shutil.copytree(log, tmp_path / "copy")).data_hash() == before


@pytest.mark.parametrize(
    ("place", "counts"), [(0, True), (4095, True), (4096, False), (195_903, False), (195_904, True), (199_999, True)]
)
def test_the_first_and_the_last_4_kb_of_what_was_recorded_count(log, place, counts):
    before = AnyFolder(log).data_hash()
    content = bytearray(200_000)
    content[place] = 1
    (log / "images" / "0.bin").write_bytes(content)
    assert (AnyFolder(log).data_hash() != before) == counts


@pytest.mark.parametrize("place", [0, 100_000, 199_999])
def test_of_what_describes_a_log_every_byte_counts(tmp_path, place):
    path = tmp_path / "boxes.json"
    path.write_bytes(bytes(200_000))
    before = hash_files(tmp_path, LogFiles(described=[path]))
    content = bytearray(200_000)
    content[place] = 1
    path.write_bytes(content)
    assert hash_files(tmp_path, LogFiles(described=[path])) != before


def test_the_order_of_files_does_not_count_and_their_absence_does(log):
    files = [log / "poses.txt", log / "images" / "0.bin", log / "boxes.json"]
    before = hash_files(log, LogFiles(recorded=files))
    assert hash_files(log, LogFiles(recorded=files[::-1])) == before
    (log / "boxes.json").touch()
    assert hash_files(log, LogFiles(recorded=files)) != before


@dataclass(frozen=True)
class OneFile(AnyFolder):
    def files(self) -> LogFiles:
        return LogFiles(recorded=[self.root / "images" / "0.bin"])


def test_what_a_reader_does_not_read_does_not_count(log):
    before = OneFile(log).data_hash(), AnyFolder(log).data_hash()
    (log / "another.log").write_text("of the same data set")
    assert OneFile(log).data_hash() == before[0]
    assert AnyFolder(log).data_hash() != before[1]


def test_names_and_sizes_count(log):
    before = AnyFolder(log).data_hash()
    (log / "images" / "0.bin").write_bytes(bytes(200_001))
    larger = AnyFolder(log).data_hash()
    (log / "images" / "0.bin").write_bytes(bytes(200_000))
    (log / "poses.txt").rename(log / "posen.txt")
    assert len({before, larger, AnyFolder(log).data_hash()}) == 3


def test_a_street_is_its_settings_wherever_it_lies(tmp_path):
    """It need not be there: what the settings say is what it shows."""
    street = StreetReader(StreetSettings(seed=3), root=tmp_path / "a")
    assert street.data_hash() == replace(street, root=tmp_path / "b").data_hash()
    assert street.data_hash() != StreetReader(StreetSettings(seed=4), root=tmp_path / "a").data_hash()
    assert street.data_hash() != StreetReader(StreetSettings(seed=3, num_frames=7)).data_hash()


@pytest.mark.parametrize("name", CLASSES)
def test_names_mean_what_the_configuration_of_their_data_set_says(name):
    classes = dict(OmegaConf.to_container(OmegaConf.load(CONF / "data" / f"{name}.yaml"))).get("classes")  # pyright: ignore
    if not isinstance(classes, dict):
        pytest.skip(f"data={name} has no classes of its own")
    for role, names in classes.items():
        assert {one: role_of(one) for one in names} == dict.fromkeys(names, role)


WIDTH, HEIGHT, FOCAL = 40, 24, 40.0
MAP = 5.4e6
FIRST = 315_969_904_359_876_000
"""Nanoseconds; the right camera fires 20 ms after the left one."""
BARREL = [-0.3, 0.05, 0.002, -0.001, 0.01]
"""Moves pixels of a 40x24 image by up to 3.38."""
OPENCV = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]


def pose(x: float, y: float, z: float, rotation=((1, 0, 0), (0, 1, 0), (0, 0, 1))) -> list[list[float]]:
    return [[*row, at] for row, at in zip(rotation, (MAP + x, y, z), strict=True)] + [[0, 0, 0, 1]]


@pytest.fixture
def root(tmp_path) -> Path:
    """Three frames of two cameras, 1 m apart along x; a point 10 m ahead of the left one, and a box 8 m ahead."""
    cameras = {}
    for number, name in enumerate(("left", "right")):
        (tmp_path / name).mkdir()
        for frame in range(3):
            pixels = np.full((HEIGHT, WIDTH, 3), 50 * frame + 100 * number, np.uint8)
            Image.fromarray(pixels).save(tmp_path / name / f"{frame:03d}.png")
        cameras[name] = {
            "k": [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]],
            "lens": BARREL if number else [0.0] * 5,
            "poses": [pose(frame, -0.5 * number, 0.0, OPENCV) for frame in range(3)],
            "stamps": [FIRST + 10**8 * frame + 2 * 10**7 * number for frame in range(3)],
        }
    (tmp_path / "lidar").mkdir()
    for frame in range(3):
        np.save(tmp_path / "lidar" / f"{frame:03d}.npy", np.array([[10.0 - frame, 0.0, 0.0]]))
    boxes = {"car": {"class": "Vehicle", "frames": [0, 2], "poses": [pose(8, 0, 0)] * 2, "sizes": [[4, 2, 1.5]] * 2}}
    stamps = [FIRST + 10**8 * frame for frame in range(3)]
    (tmp_path / "log.json").write_text(json.dumps({"stamps": stamps, "cameras": cameras, "boxes": boxes}))
    return tmp_path


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    log = json.loads((root / "log.json").read_text())
    change(log)
    (root / "log.json").write_text(json.dumps(log))


def test_it_reads_as_a_log(root):
    log = ToyRigReader(root).read()
    assert (log.num_frames, log.num_cameras, len(log.sweeps), len(log.tracks)) == (3, 2, 3, 1)
    assert log.frames[0].camera.position.tolist() == [0.0, 0.0, 0.0]
    assert log.frames[3].camera.position.tolist() == [1.0, -0.5, 0.0]
    assert log.frames[2].image[0, 0].tolist() == [50, 50, 50]
    assert log.frames[0].depth[HEIGHT // 2, WIDTH // 2] == 10.0
    assert log.sweeps[1].points.tolist() == [[10.0, 0.0, 0.0]]
    assert (log.sweeps[1].colors[0] * 255).tolist() == pytest.approx([50, 50, 50])
    assert log.tracks[0].world_from_object[0, :3, 3].tolist() == [8.0, 0.0, 0.0]
    assert log.dataset_from_world[:3, 3].tolist() == [MAP, 0.0, 0.0]


def test_its_cameras_have_instants_of_their_own(root):
    log = ToyRigReader(root).read()
    assert [view.seconds for view in log.views] == [0.0, 0.02, 0.1, 0.12, 0.2, 0.22]
    assert [view.time for view in log.views] == pytest.approx([0, 2 / 22, 10 / 22, 12 / 22, 20 / 22, 1], abs=1e-12)
    assert [sweep.time for sweep in log.sweeps] == pytest.approx([0, 10 / 22, 20 / 22], abs=1e-12)
    assert log.frames[3].stamp == FIRST + 120_000_000
    assert (log.sweeps[1].stamp, log.frame_rate) == (FIRST + 100_000_000, 10.0)


def test_its_notes_are_what_is_absent_and_what_becomes_of_its_lenses(root):
    *absent, lens = ToyRigReader(root).read().notes
    assert [note.split(":")[0] for note in absent] == ["no sky masks", "no human masks", "no vehicle masks"]
    assert lens == "camera right: its lens moves pixels by up to 3.38"
    assert torch.equal(there(ToyRigReader(root).read().views[1].camera.distortion), torch.tensor(BARREL))


def test_a_window_a_camera_and_a_width(root):
    log = ToyRigReader(root, cameras=["right"], first_frame=1, width=20).read()
    assert [(view.frame_index, view.camera_index, view.seconds) for view in log.views] == [(0, 0, 0.02), (1, 0, 0.12)]
    assert log.frames[0].image.shape == (12, 20, 3)
    assert log.frames[0].camera.intrinsics[0].tolist() == [20.0, 0.0, 10.0]
    assert log.tracks[0].frames.tolist() == [1]
    with pytest.raises(ValueError, match="frames 0 to 3 are not within the log's 0 to 2"):
        ToyRigReader(root, last_frame=3).read()
    with pytest.raises(ValueError, match=r"cameras \['middle'\] must be different ones of the log's"):
        ToyRigReader(root, cameras=["middle"]).read()


FAULTS = {
    "scaled pose": (
        lambda root: edit(root, lambda log: log["cameras"]["left"]["poses"][1][0].__setitem__(2, 1.1)),
        "the pose of left at frame 1 is no rigid transform",
    ),
    "lens": (lambda root: edit(root, lambda log: log["cameras"]["right"].update(lens=[0, 0, 1, 1, 0])), "no inverse"),
    "far": (
        lambda root: edit(root, lambda log: log["cameras"]["left"]["poses"][2][0].__setitem__(3, 0)),
        "span 5400.0",
    ),
    "box": (lambda root: edit(root, lambda log: log["boxes"]["car"].update(frames=[2, 0])), "not strictly increasing"),
    "image": (lambda root: (root / "left" / "001.png").write_bytes(b"torn"), "cannot be decoded"),
    "size": (lambda root: Image.new("RGB", (8, 8)).save(root / "left" / "001.png"), "the image is 8x8"),
    "points": (lambda root: np.save(root / "lidar" / "001.npy", np.array([[np.nan, 0, 0]])), "1 of 1 points"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_found_as_in_any_log(name, root):
    assert ToyRigReader(root).check() == []
    corrupt, said = FAULTS[name]
    corrupt(root)
    (problem,) = ToyRigReader(root).check()
    assert said in problem.message
    assert problem.remedy
    with pytest.raises(LogError):
        ToyRigReader(root).read()


def test_a_file_that_breaks_later_is_explained_by_a_check(root):
    log = ToyRigReader(root).read()
    (root / "right" / "002.png").write_bytes(b"torn")
    assert log.frames[0].frame_index == 0
    with pytest.raises(LogError, match=r"1 problem in the log:\n.*002\.png"):
        log.frames[5]


def test_its_hash_is_of_what_it_reads(root):
    before = ToyRigReader(root).data_hash()
    (root / "other.json").write_text("{}")
    assert ToyRigReader(root).data_hash() == before
    edit(root, lambda log: log["boxes"].clear())
    assert ToyRigReader(root).data_hash() != before


def test_it_copies_nothing(root):
    """No statement of a line or more, imports and signatures aside, is in DriveStudio's reader too."""
    import sparsestreet.data.drivestudio as other
    from tests.data import toy_rig

    def statements(path: Path) -> set[str]:
        body = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.stmt)]
        kinds = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.AnnAssign)
        return {ast.unparse(node) for node in body if not isinstance(node, kinds)}

    theirs = set().union(*(statements(path) for path in Path(other.__file__).parent.glob("*.py")))
    shared = {statement for statement in statements(Path(toy_rig.__file__)) & theirs if len(statement) > 30}
    assert shared == set()
