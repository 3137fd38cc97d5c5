"""What is no scene, is damaged, or cannot be written: one error each, and no file is lost."""

import errno
import json
import re
import resource
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from sparsestreet.codec.container import MAGIC
from sparsestreet.scene import storage
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.loaded_scene import VERSION
from sparsestreet.scene.storage import SCENE_FILE, load_scene, save_scene
from tests.scene.stored import pixels, stored, view


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A good scene file."""
    save_scene(tmp_path / SCENE_FILE, stored())
    return tmp_path / SCENE_FILE


def rewritten(path: Path, change: Callable[[dict, dict], object]) -> None:
    """The same file with a change of its header or its tensors."""
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["sparsestreet"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    change(header, tensors)
    save_file(tensors, path, metadata={"sparsestreet": json.dumps(header)})


def test_no_file(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=f"there is no scene at .*{SCENE_FILE}: give a {SCENE_FILE}, or"):
        load_scene(tmp_path / SCENE_FILE)
    with pytest.raises(FileNotFoundError, match=f"there is no scene at {tmp_path}/{SCENE_FILE}"):
        load_scene(tmp_path)


@pytest.mark.parametrize("length", [0, 7, 100, -4])
def test_a_truncated_file(path: Path, length: int):
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ValueError, match=f"{path} is no scene file or is damaged .*: write it again"):
        load_scene(path)


FOREIGN = {
    "a.ply": (b"ply\nformat ascii 1.0\n", "holds Gaussians of one moment for viewers, or points, not a scene"),
    "a.splat": (bytes(32), "holds Gaussians of one moment for viewers"),
    "A.KSPLAT": (bytes(4096), "holds Gaussians of one moment for viewers"),
    "a.sog": (b"PK\3\4" + bytes(20), "holds Gaussians of one moment for viewers"),
    "a.compressed.ply": (b"ply\nformat", "holds Gaussians of one moment for viewers"),
    "a.usdz": (b"PK\3\4" + bytes(20), "holds what AlpaSim loads beside the pictures"),
    "a.html": (b"<!doctype html>", "holds a page for browsers"),
    "a.mp4": (bytes(4) + b"ftypisom", "holds a video"),
    "last.ckpt": (b"PK\3\4" + bytes(20), "holds a checkpoint that a training goes on from"),
    "views.json": (b"{}", "holds text"),
    "a": (b"\x89PNG\r\n", "holds a picture"),
    "scene.safetensors": (b"\x1f\x8b" + bytes(20), "holds what gzip packed, such as a .spz"),
    "b.street": (b"PK\3\4" + bytes(20), "holds a zip archive"),
    "a.blend": (b"BLENDER", "holds bytes that are not known"),
    "a.npz": (b"", "holds nothing"),
    "c.street": (bytes([90, *bytes(7), 123]) + bytes(90), "is a .safetensors by its first bytes: give it that ending"),
    "d.safetensors": (MAGIC + bytes(20), "is a .street by its first bytes: give it that ending"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_other_programs_are_named_for_what_they_are(name: str, tmp_path: Path):
    content, said = FOREIGN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(f"{tmp_path / name} {said}")) as found:
        load_scene(tmp_path / name)
    assert "damaged" not in str(found.value)
    assert said.startswith("is a") or f"open the run's folder, its {SCENE_FILE} or a .street" in str(found.value)


def test_a_folder_of_runs_says_so(path: Path, tmp_path: Path):
    shutil.copytree(path.parent, tmp_path / "more" / "run_3")
    with pytest.raises(FileNotFoundError, match=r"the folder of a run that has one \(such as run_3 in it\)"):
        load_scene(tmp_path / "more")


def test_tensors_of_another_program(path: Path):
    for metadata in (None, {"format": "pt"}):
        save_file({"weight": torch.zeros(3)}, path, metadata=metadata)
        with pytest.raises(
            ValueError, match=f"{path}: the file holds tensors but no scene of ours: give the {SCENE_FILE}"
        ):
            load_scene(path)


def test_a_newer_version(path: Path):
    rewritten(path, lambda header, _: header.update(version=VERSION + 1))
    with pytest.raises(
        ValueError, match=f"{path}: the file has version {VERSION + 1}, this program reads {VERSION}: update it"
    ):
        load_scene(path)


@pytest.mark.parametrize("version", [1, VERSION - 1])
def test_an_earlier_version(path: Path, version: int):
    rewritten(path, lambda header, _: (header.update(version=version), header.pop("effects")))
    said = f"{path}: the file has version {version}, this program reads {VERSION}: train the scene again, or open it"
    with pytest.raises(ValueError, match=f"{said} with the version that wrote it"):
        load_scene(path)


def settings_of(header: dict) -> dict:
    return header["nodes"]["road"]["settings"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sparsestreet.scene.nodes.background:Meadow", "which this version does not have"),
        ("sparsestreet.scene.nodes.meadow:Meadow", "which this version does not have"),
        ("my_street.nodes:Meadow", "which this program has not imported: import my_street.nodes first"),
        ("sparsestreet.scene.nodes.background:Background", "no dataclass: the file is damaged"),
        ("os:system", "no dataclass: the file is damaged"),
        ("", "which this program has not imported"),
    ],
)
def test_a_class_that_is_not_known(path: Path, name: str, message: str):
    rewritten(path, lambda header, _: settings_of(header).update({"class": name}))
    with pytest.raises(ValueError, match=f"{path}: the file uses '{name}'.*{message}"):
        load_scene(path)


def test_a_setting_that_contradicts_another(path: Path):
    rewritten(path, lambda header, _: settings_of(header).update(min_gaussians=-1))
    with pytest.raises(ValueError, match="min_gaussians must be >= 0, got -1"):
        load_scene(path)


DAMAGES = {
    "no column": lambda header, tensors: tensors.pop("nodes.road.rows.means"),
    "no keyframes": lambda header, tensors: tensors.pop("nodes.cars.keyframe_times"),
    "no sky": lambda header, tensors: tensors.pop("effects.sky.texels"),
    "a tensor of no node": lambda header, tensors: tensors.update(stray=torch.zeros(2)),
    "a node less": lambda header, tensors: header["nodes"].pop("trees"),
    "no version": lambda header, tensors: header.pop("version"),
    "a version in words": lambda header, tensors: header.update(version="one"),
    "no options": lambda header, tensors: header.pop("options"),
    "no list of columns": lambda header, tensors: header["nodes"]["road"].pop("columns"),
    "a list for a mapping": lambda header, tensors: header.update(nodes=[1, 2]),
    "no names": lambda header, tensors: header["nodes"]["cars"].update(header={}),
    "settings of something else": lambda header, tensors: header["nodes"]["road"].update(settings=header["options"]),
    "settings that are none": lambda header, tensors: header["nodes"]["road"].update(settings=None),
    "options that are none": lambda header, tensors: header.update(options=settings_of(header)),
    "no effects": lambda header, tensors: header.pop("effects"),
    "a sky of something else": lambda header, tensors: header["effects"]["sky"].update(settings=header["options"]),
}


def test_a_scene_of_nothing(path: Path):
    rewritten(path, lambda header, _: header.update(nodes={}))
    with pytest.raises(ValueError, match=f"{path}: a scene needs at least one node"):
        load_scene(path)


def test_a_device_that_is_not_there_is_no_fault_of_the_file(path: Path):
    with pytest.raises(RuntimeError, match=r"(?i)device") as caught:
        load_scene(path, "abacus")
    assert "damaged" not in str(caught.value)


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_header_that_does_not_fit_its_tensors(path: Path, damage: Callable[[dict, dict], object]):
    rewritten(path, damage)
    with pytest.raises(ValueError, match=f"{path} is no scene file or is damaged .*: write it again"):
        load_scene(path)


def test_a_header_that_is_no_json(path: Path):
    for text in ("{", "[1]", "3"):
        save_file({"weight": torch.zeros(3)}, path, metadata={"sparsestreet": text})
        with pytest.raises(ValueError, match=f"{path} is no scene file or is damaged"):
            load_scene(path)


def only(path: Path, content: bytes) -> bool:
    """Whether the folder holds the file as it was, and nothing beside it."""
    return [entry.name for entry in path.parent.iterdir()] == [path.name] and path.read_bytes() == content


def half_written(tensors: dict, filename: Path, metadata: dict) -> None:
    Path(filename).write_bytes(b"half of a scene")
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_the_old_file_whole_and_no_temporary(path: Path, monkeypatch: pytest.MonkeyPatch):
    content = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(storage, "save_file", half_written)
        with pytest.raises(OSError, match="No space left"):
            save_scene(path, stored(3))
    assert only(path, content)
    assert all(map(torch.equal, pixels(load_scene(path).render(view())), pixels(stored().render(view()))))
    save_scene(path, stored(3))
    assert load_scene(path).scene.nodes["road"].rows.sh_rest.shape[1] == 15


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """The system refuses to write more into one file, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)


def test_a_write_that_the_system_refuses(path: Path):
    content = path.read_bytes()
    with files_up_to(len(content) // 2), pytest.raises(OSError, match=f"{path} cannot be written"):
        save_scene(path, stored(3))
    assert only(path, content)


@dataclass(frozen=True)
class Odd(GradientDensity):
    memory: object = None


def test_settings_that_are_no_plain_values_are_refused_before_anything_is_written(path: Path):
    content, scene = path.read_bytes(), stored()
    road = scene.scene.nodes["road"]
    road.settings = replace(road.settings, density=Odd(memory=torch.zeros(2)))
    with pytest.raises(TypeError, match="got a Tensor"):
        save_scene(path, scene)
    assert only(path, content)
