"""A converted log appears whole or not at all, and what was interrupted goes on where it was."""

import errno
import json
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import pytest

from sparsestreet.data.convert import DESCRIPTION, LogFile, LogWriter, Show, Source, convert, partial_folder
from sparsestreet.data.drivestudio import DriveStudioReader, DriveStudioWriter
from sparsestreet.data.log import DrivingLog
from tests.data.plan import make_log

SOURCE = Source("tiny", "0123456789ab", {"width": None})


@dataclass(frozen=True)
class Letters(LogWriter):
    names: tuple[str, ...] = ("a", "sub/b", "sub/c")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        for name in self.names:
            yield LogFile(name, lambda name=name: (name.encode(), b" whole"))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        return ("3 letters are lost",)


def cut_at(number: int, act: Callable[[], object]) -> Show:
    """Something happens when half of this file is written."""

    def show(files: Iterable[LogFile], total: int, what: str) -> Iterator[LogFile]:
        for count, file in enumerate(files):
            yield LogFile(file.path, lambda file=file: _cut(file, act)) if count == number else file

    return show


def _cut(file: LogFile, act: Callable[[], object]) -> Iterator[bytes]:
    content = b"".join(file.content())
    yield content[: len(content) // 2]
    act()
    yield content[len(content) // 2 :]


def fail(error: BaseException) -> NoReturn:
    raise error


def tree(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def killed_in(number: int, writer: LogWriter, folder: Path) -> None:
    """Convert in another process, which is killed within a file."""
    child = os.fork()
    if child == 0:
        convert(make_log(), SOURCE, writer, folder, cut_at(number, lambda: os.kill(os.getpid(), signal.SIGKILL)))
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL


def test_the_folder_has_the_files_and_says_what_they_are_of(tmp_path):
    made = convert(make_log(), SOURCE, Letters(), tmp_path / "out")
    assert (made.files, made.found, made.bytes, made.losses) == (3, 0, 29, ("3 letters are lost",))
    found = tree(tmp_path / "out")
    described = json.loads(found.pop(DESCRIPTION))
    assert found == {"a": b"a whole", "sub/b": b"sub/b whole", "sub/c": b"sub/c whole"}
    assert described["source"] == {"name": "tiny", "data_hash": "0123456789ab", "reader": {"width": None}}
    assert described["layout"] == "tests.data.test_convert.Letters"
    assert (described["frames"], described["cameras"]) == (12, ["0", "1"])
    assert described["losses"] == ["3 letters are lost"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("number", [0, 1, 30, -1])
def test_a_killed_conversion_goes_on_and_no_byte_is_another(number, tmp_path):
    writer = DriveStudioWriter()
    count = len(list(writer.files(make_log())))
    number %= count
    killed_in(number, writer, tmp_path / "out")
    partial = partial_folder(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    there = {path: path.stat().st_ino for path in partial.rglob("*") if path.is_file() and path.suffix != ".tmp"}
    assert len(there) == number + 1  # and the description
    assert list(partial.glob("*.tmp"))  # half of a file, which nobody takes for a whole one
    made = convert(make_log(), SOURCE, writer, tmp_path / "out")
    assert (made.files, made.found) == (count, number)
    left = {tmp_path / "out" / path.relative_to(partial): inode for path, inode in there.items()}
    assert {path: path.stat().st_ino for path in left} == left  # not written again
    convert(make_log(), SOURCE, writer, tmp_path / "at once")
    assert tree(tmp_path / "out") == tree(tmp_path / "at once")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["at once", "out"]
    assert DriveStudioReader(tmp_path / "out").check() == []


def interrupted(folder: Path) -> Path:
    """A partial folder with one of three files."""
    with pytest.raises(KeyboardInterrupt):
        convert(make_log(), SOURCE, Letters(), folder, cut_at(1, lambda: fail(KeyboardInterrupt())))
    return partial_folder(folder)


@pytest.mark.parametrize(
    ("source", "writer", "said"),
    [
        (replace(SOURCE, data_hash="ffffffffffff"), Letters(), "differs in source"),
        (replace(SOURCE, reader={"width": 100}), Letters(), "differs in source"),
        (SOURCE, Letters(names=("a", "sub/b")), "differs in settings"),
        (SOURCE, DriveStudioWriter(), "differs in layout, settings, losses, notes"),
    ],
)
def test_a_partial_folder_of_something_else_is_left_as_it_is(source, writer, said, tmp_path):
    partial = interrupted(tmp_path / "out")
    before = tree(partial)
    assert set(before) == {"a", DESCRIPTION}
    with pytest.raises(OSError, match=f"{said}: remove it, or name another place"):
        convert(make_log(), source, writer, tmp_path / "out")
    assert tree(partial) == before
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["mine.txt", "sub/b.jpg"])
def test_a_partial_folder_with_files_of_others_is_left_as_it_is(name, tmp_path):
    partial = interrupted(tmp_path / "out")
    (partial / name).parent.mkdir(exist_ok=True)
    (partial / name).write_text("mine")
    with pytest.raises(OSError, match="is no file of this conversion: remove"):
        convert(make_log(), SOURCE, Letters(), tmp_path / "out")
    (partial / DESCRIPTION).unlink()
    with pytest.raises(OSError, match="is of no conversion"):
        convert(make_log(), SOURCE, Letters(), tmp_path / "out")
    assert (partial / name).read_text() == "mine"


@pytest.mark.parametrize("kind", ["finished", "folder", "file", "partial file"])
def test_nothing_that_is_in_the_way_is_touched(kind, tmp_path):
    out = tmp_path / "out"
    if kind == "finished":
        convert(make_log(), SOURCE, Letters(), out)
    elif kind == "folder":
        out.mkdir()
        (out / "mine.txt").write_text("mine")
    else:
        (out if kind == "file" else partial_folder(out)).write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(FileExistsError, match="name another place"):
        convert(make_log(), SOURCE, Letters(), out)
    assert tree(tmp_path) == before


def test_an_empty_folder_is_taken_and_folders_above_are_made(tmp_path):
    (tmp_path / "empty").mkdir()
    convert(make_log(), SOURCE, Letters(), tmp_path / "empty")
    convert(make_log(), SOURCE, Letters(), tmp_path / "new/deep")
    assert tree(tmp_path / "empty") == tree(tmp_path / "new/deep")


def test_a_full_disk_leaves_what_is_whole(tmp_path):
    full = cut_at(1, lambda: fail(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match=r"the disk is full after 1 of 3 files, which stay in .*give the same command"):
        convert(make_log(), SOURCE, Letters(), tmp_path / "out", full)
    assert convert(make_log(), SOURCE, Letters(), tmp_path / "out").found == 1


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OSError, match=r"cannot be written .*: name another place with to="):
        convert(make_log(), SOURCE, Letters(), tmp_path / "file/out")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("/a",), "below its folder"),
        (("b/../../a",), "below its folder"),
        ((DESCRIPTION,), "below its folder"),
        (("a", "b", "a"), "'a' 2 times"),
    ],
)
def test_a_writer_that_names_other_files_is_refused(names, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        convert(make_log(), SOURCE, Letters(names=names), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_log_that_the_layout_cannot_hold_leaves_nothing(tmp_path):
    log = make_log()
    log = replace(log, frames=log.frames.where(lambda view: view.indices != (3, 1)))
    with pytest.raises(ValueError, match="1 of 24 are absent, the first of camera 1 at frame 3: leave such frames"):
        convert(log, SOURCE, DriveStudioWriter(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_only_what_is_still_to_be_written_is_shown(tmp_path):
    interrupted(tmp_path / "out")
    seen = []

    def show(files: Iterable[LogFile], total: int, what: str) -> Iterator[LogFile]:
        seen.append((total, what))
        yield from files

    convert(make_log(), SOURCE, Letters(), tmp_path / "out", show)
    assert seen == [(2, "files")]
