"""A disk that is full, at each kind of file that a run writes: the old file stays whole, no half one stays, and the
error names file, free space and remedy. The system itself refuses: no file may grow beyond a few bytes."""

import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from sparsestreet.atomic import atomic_file, atomic_folder
from sparsestreet.export.video import write_pictures
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, CountChange, HeldOutLook


@contextmanager
def no_room(limit: int) -> Iterator[None]:
    """Files end at ``limit`` bytes: writes beyond it fail as they do on a full disk (EFBIG in place of ENOSPC)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    # An import would leave half a compiled module, which no later process can read.
    compiled, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = compiled
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def by_torch(path: Path) -> None:
    with atomic_file(path) as temporary:
        torch.save({"a": torch.zeros(5000)}, temporary)


def by_safetensors(path: Path) -> None:
    with atomic_file(path) as temporary:
        save_file({"a": torch.zeros(5000)}, temporary)


def picture(path: Path) -> None:
    with atomic_file(path) as temporary:
        noise = np.random.default_rng(0).integers(0, 255, (50, 50, 3), dtype=np.uint8)
        Image.fromarray(noise).save(temporary)


def curve(path: Path) -> None:
    HELD_OUT_CURVE.write_to(path, [HeldOutLook(1.0, step, 20.0, None, None) for step in range(100)])


def ledger(path: Path) -> None:
    LEDGER.write_to(path, [CountChange(step, "background", 1, 2, "densify") for step in range(100)])


def video(path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (2, 64, 64, 3), dtype=np.uint8)
    write_pictures(path, list(noise), fps=10.0)


WRITERS = {
    "c.ckpt": by_torch,
    "s.safetensors": by_safetensors,
    "p.png": picture,
    "h.csv": curve,
    "l.csv": ledger,
    "v.mp4": video,
}


@pytest.mark.parametrize(("name", "write"), WRITERS.items())
def test_the_old_file_stays_whole_and_the_error_names_what_to_do(name: str, write: Callable[[Path], None], tmp_path):
    path = tmp_path / name
    path.write_bytes(b"old")
    with (
        no_room(100),
        pytest.raises(OSError, match=rf"{name} cannot be written .* MB are free there. .*make room"),
    ):
        write(path)
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == {name: b"old"}
    write(path)
    assert len(path.read_bytes()) > 100
    assert [one.name for one in tmp_path.iterdir()] == [name]


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with no_room(100), pytest.raises(OSError, match=r"film cannot be written .*make room"), atomic_folder(
        tmp_path / "film"
    ) as folder:  # fmt: skip
        (folder / "a.txt").write_text("short")
        (folder / "b.txt").write_text("x" * 200)
    assert list(tmp_path.iterdir()) == []


def test_other_errors_stay_what_they_are(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "a.txt") as temporary:
        temporary.write_text(str(1 // 0))
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "b") as folder:
        (folder / "no" / "such.txt").write_text("")
    assert list(tmp_path.iterdir()) == []
