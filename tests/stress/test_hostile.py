"""Files that somebody wrote to run code, or to take all memory: refused, and nothing ran.

Each is opened by a process that may reserve little more memory than it holds, so one that takes more fails with another
sentence than the one that is asked for.
"""

import gzip
import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
import pytest
import torch

from sparsestreet.data.images import image_size, read_image
from sparsestreet.data.pandaset.frames import read_columns
from sparsestreet.data.ply import read_ply
from sparsestreet.evaluation.evaluate import Predictions
from sparsestreet.files import read_npz, read_yaml
from sparsestreet.pickles import read_pickled
from sparsestreet.scene.body import SmplFile
from sparsestreet.scene.edits import read_edits
from sparsestreet.scene.storage import load_scene
from sparsestreet.scene.views import read_views
from sparsestreet.training.callbacks.files import step_of
from tests.data.damage import Damage, long, written
from tests.stress.forked import Forked, command
from tests.stress.runs import MORE_MB, assert_refused, contents, cut_short, on_drive, street_of
from tests.stress.test_damaged import finished

__all__ = ["finished"]

OPENED_MB = 400
"""Memory that opening one file may reserve beyond what the process holds: tensors of a test's files take below 1 MB."""
DEEP = written(b"[" * 200_000)
RAN = "it_ran"
"""A file that code of a hostile file would leave beside it."""


class Runs:
    """Runs code when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.system, (f"touch {self.folder / RAN}",)


def running_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps({"global_step": Runs(path.parent), "means": np.zeros(3)}, 2))


def running_checkpoint(path: Path) -> None:
    torch.save({"global_step": Runs(path.parent)}, path)


def running_npz(path: Path) -> None:
    np.savez(path, names=np.array([Runs(path.parent)], dtype=object), allow_pickle=True)


def running_yaml(path: Path) -> None:
    path.write_text(f"remove: !!python/object/apply:os.system ['touch {path.parent / RAN}']\n")


def laughs(path: Path) -> None:
    """Eleven lines that stand for 9^11 entries."""
    lines = ["remove: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 11)]
    path.write_text("\n".join(lines))


def png_bomb(path: Path) -> None:
    """A whole PNG whose header announces 100,000 x 100,000 pixels."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", 100_000, 100_000, 16, 2, 0, 0, 0)
    rows = zlib.compress(bytes(50_000_000), 9)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))


def zip_bomb(path: Path) -> None:
    """3 GB of zeros in 3 MB, as an array of the points' cache."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (750_000_000,)})
    packed = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9)
    with packed as archive, archive.open("names.npy", "w", force_zip64=True) as file:
        file.write(header.getvalue())
        for _ in range(3000):
            file.write(bytes(1_000_000))


def absurd_npz(path: Path) -> None:
    """An array whose header announces a terabyte."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 37,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("names.npy", header.getvalue() + bytes(64))


def packed_checkpoint(path: Path) -> None:
    """A checkpoint whose tensor is 1 GB of zeros, packed to 1 MB."""
    buffer = io.BytesIO()
    torch.save({"global_step": 1, "means": torch.zeros(1000)}, buffer)
    with zipfile.ZipFile(buffer) as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
        for entry in source.infolist():
            name = entry.filename
            with packed.open(name, "w", force_zip64=True) as file:
                if not name.endswith("data/0"):
                    file.write(source.read(name).replace(b"M\xe8\x03", b"J\x00\x00\x00\x10"))
                    continue
                for _ in range(1024):
                    file.write(bytes(1 << 20))


def absurd_checkpoint(path: Path) -> None:
    """A checkpoint whose tensor announces 2^28 numbers, of which 1,000 are there."""
    buffer = io.BytesIO()
    torch.save({"global_step": 1, "means": torch.zeros(1000)}, buffer)
    with zipfile.ZipFile(buffer) as source, zipfile.ZipFile(path, "w") as changed:
        for entry in source.infolist():
            changed.writestr(entry.filename, source.read(entry.filename).replace(b"M\xe8\x03", b"J\x00\x00\x00\x10"))


def tensors(header: object, *, length: int | None = None) -> Damage:
    """A safetensors file of this header, and 8 bytes of numbers."""
    text = json.dumps(header).encode() if not isinstance(header, bytes) else header
    return written(struct.pack("<Q", len(text) if length is None else length) + text + bytes(8))


def of_shape(*shape: int, end: int) -> dict[str, object]:
    return {"means": {"dtype": "F32", "shape": list(shape), "data_offsets": [0, end]}}


def gzip_bomb(path: Path) -> None:
    """2 GB of zeros in 2 MB."""
    with gzip.open(path, "wb", compresslevel=9) as file:
        for _ in range(2000):
            file.write(bytes(1_000_000))


def ply(count: int, form: str) -> Damage:
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}", *(f"property float {axis}" for axis in "xyz")]
    return written("\n".join([*lines, "end_header", "1 2 3\n"]).encode())


def huge_views(path: Path) -> None:
    """A picture of 10^12 pixels."""
    unit = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    pose = [[*row, 0.0] for row in unit] + [[0.0, 0.0, 0.0, 1.0]]
    view = {"split": "training", "frame_index": 0, "camera_index": 0, "time": 0.0, "width": 10**6, "height": 10**6}
    said = {"format": 2, "frame_rate": 10.0, "views": [view | {"camera_from_world": pose, "intrinsics": unit}]}
    path.write_text(json.dumps(said))


def no_scene(asked: object) -> NoReturn:
    raise AssertionError(asked)


class Case(NamedTuple):
    make: Damage
    name: str
    opened: Callable[[Path], object]
    says: str


FILES = {
    "a pickle that runs code": Case(running_pickle, "smpl.pkl", read_pickled, "asks for posix.system"),
    "SMPL's body that runs code": Case(
        running_npz, "SMPL.npz", lambda path: SmplFile(str(path)).load(), "is not SMPL's body"
    ),
    "a pickle of brackets": Case(written(b"(" * 10**6), "smpl.pkl", read_pickled, "must be a pickle of plain values"),
    "a pickle of a terabyte": Case(
        written(b"\x80\x05\x8e" + struct.pack("<Q", 1 << 40)), "smpl.pkl", read_pickled, "must be a pickle of plain"
    ),
    "a checkpoint that runs code": Case(running_checkpoint, "last.ckpt", step_of, "holds what may run code"),
    "a bare pickle as checkpoint": Case(running_pickle, "last.ckpt", step_of, "holds what may run code"),
    "a packed checkpoint": Case(packed_checkpoint, "last.ckpt", step_of, "it is compressed"),
    "an absurd checkpoint": Case(absurd_checkpoint, "last.ckpt", step_of, "is no checkpoint of a training"),
    "a zip bomb": Case(zip_bomb, "points.npz", read_npz, "its arrays would take 3,000,000,1"),
    "an absurd array": Case(absurd_npz, "points.npz", read_npz, "has 64 bytes"),
    "an array that runs code": Case(running_npz, "points.npz", read_npz, "allow_pickle=False"),
    "YAML that runs code": Case(
        running_yaml, "edits.yaml", lambda path: read_edits(path, 1.0, no_scene), "could not determine a constructor"
    ),
    "YAML that laughs": Case(laughs, "edits.yaml", lambda path: read_edits(path, 1.0, no_scene), "holds aliases"),
    "YAML of brackets": Case(DEEP, "edits.yaml", lambda path: read_edits(path, 1.0, no_scene), "without end"),
    "YAML of a gigabyte": Case(long(10**9), "a.yaml", lambda path: read_yaml(path, no_scene), "shorten it"),
    "a header of 2^60 bytes": Case(
        tensors({}, length=1 << 60), "scene.safetensors", load_scene, "is no scene file or is damaged"
    ),
    "a header of 4 GB": Case(
        tensors({}, length=1 << 32), "scene.safetensors", load_scene, "is no scene file or is damaged"
    ),
    "a tensor of a terabyte": Case(
        tensors(of_shape(1 << 38, end=1 << 40)), "scene.safetensors", load_scene, "is no scene file or is damaged"
    ),
    "a tensor that wraps around": Case(
        tensors(of_shape(1 << 62, 4, end=0)), "scene.safetensors", load_scene, "is no scene file or is damaged"
    ),
    "a header of brackets": Case(
        tensors({"__metadata__": {"sparsestreet": "[" * 10**5}}), "scene.safetensors", load_scene, "is damaged"
    ),
    "an image of 10^10 pixels": Case(
        png_bomb, "000_0.png", lambda path: read_image(path, (64, 40)), "the image cannot be decoded"
    ),
    "its size": Case(png_bomb, "000_0.png", image_size, "the image cannot be decoded"),
    "a prediction of 10^10 pixels": Case(
        png_bomb, "000_0.png", lambda path: Predictions(path.parent).read(0, 0), "cannot be decoded"
    ),
    "a table of 2 GB": Case(
        gzip_bomb, "00.pkl.gz", lambda path: read_columns(path, {"x": float}), "the table takes more than"
    ),
    "10^12 points as text": Case(ply(10**12 - 1, "ascii"), "a.ply", read_ply, "999,999,999,999 points"),
    "10^12 points": Case(ply(10**12 - 1, "binary_little_endian"), "a.ply", read_ply, "999,999,999,999 points"),
    "views of brackets": Case(DEEP, "views.json", read_views, "brackets in brackets without end"),
}
SHORT_FORM = ("a checkpoint that runs code", "an absurd array", "YAML that laughs", "a tensor of a terabyte",
              "a prediction of 10^10 pixels", "views of brackets")  # fmt: skip


def check(case: Case, folder: Path) -> None:
    path = folder / case.name
    case.make(path)

    def opened() -> None:
        try:
            case.opened(path)
        except ValueError as error:
            print(error)
            raise SystemExit(1) from error

    ended = Forked(opened, folder / "log", more_mb=OPENED_MB).join(60)
    assert ended.status == 1, ended
    assert case.says in ended.said
    assert "Traceback" not in ended.said
    assert not (folder / RAN).exists()


@pytest.mark.stress
@pytest.mark.parametrize("case", FILES.values(), ids=FILES)
def test_a_file(case, tmp_path):
    check(case, tmp_path)


@pytest.mark.lengthy
@pytest.mark.parametrize("name", SHORT_FORM)
def test_the_short_form(name, tmp_path):
    check(FILES[name], tmp_path)


OF_A_RUN = {
    "a configuration that laughs": (("evaluate", "{run}"), ".hydra/config.yaml", laughs, "holds aliases"),
    "a configuration that runs code": (("evaluate", "{run}"), ".hydra/config.yaml", running_yaml, "is no YAML"),
    "a start that laughs": (("evaluate", "{run}"), ".hydra/hydra.yaml", laughs, "holds aliases"),
    "words that laugh": (("train", "resume={run}"), ".hydra/overrides.yaml", laughs, "holds aliases"),
    "a checkpoint that runs code": (
        ("train", "resume={run}"), "checkpoints/last.ckpt", running_checkpoint, "holds what may run code"
    ),
    "a packed checkpoint": (
        ("train", "resume={run}"), "checkpoints/last.ckpt", packed_checkpoint, "is no checkpoint of a training"
    ),
    "a description of brackets": (("evaluate", "{run}"), "run.json", DEEP, "brackets in brackets without end"),
    "a picture of 10^12 pixels": (("render", "{run}", "{run}.mp4"), "views.json", huge_views, "16,384 pixels a side"),
}  # fmt: skip


@pytest.mark.stress
@pytest.mark.parametrize(("words", "name", "make", "says"), OF_A_RUN.values(), ids=OF_A_RUN)
def test_a_run(words, name, make, says, finished, tmp_path):
    run = tmp_path / "run"
    (cut_short if words[0] == "train" else shutil.copytree)(finished[1], run)
    make(run / name)
    before = contents(run)
    ended = command([word.format(run=run) for word in words], tmp_path / "log", more_mb=MORE_MB, limit=60)
    assert_refused(ended, says)
    assert contents(run) == before
    assert not list(tmp_path.rglob(RAN))


OF_A_DRIVE = {
    "an image of 10^10 pixels": ("images/003_0.jpg", png_bomb, "the image cannot be decoded"),
    "a mask of 10^10 pixels": ("sky_masks/003_0.png", png_bomb, "the image cannot be decoded"),
    "people that run code": ("humanpose/smpl.pkl", running_pickle, "asks for posix.system"),
    "boxes of brackets": ("instances/instances_info.json", DEEP, "the file is no JSON"),
}


@pytest.mark.stress
@pytest.mark.parametrize(("name", "make", "says"), OF_A_DRIVE.values(), ids=OF_A_DRIVE)
def test_a_drive(name, make, says, tiny_street, tmp_path):
    shutil.copytree(street_of(tiny_street), tmp_path / "drive")
    make(tmp_path / "drive" / name)
    ended = command(on_drive(tmp_path / "drive", tmp_path / "out"), tmp_path / "log", more_mb=MORE_MB, limit=60)
    assert_refused(ended, says)
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.rglob(RAN))
