import contextlib
import os
import socket

import pytest

from sparsestreet.atomic import atomic_file, atomic_folder, check_regular
from sparsestreet.data.colmap import reader as colmap
from sparsestreet.data.images import check_pixels, image_size, read_image
from sparsestreet.data.nuscenes.tables import all_rows
from sparsestreet.data.ply import read_ply
from sparsestreet.files import read_npz, read_yaml
from sparsestreet.pickles import read_pickled
from sparsestreet.records.strict_json import read_text
from sparsestreet.training.callbacks.files import step_of


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_takes_its_place_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with atomic_file(path) as temporary:
        temporary.write_text("one")
        assert temporary.suffix == ".txt"
        assert not path.exists()
    assert path.read_text() == "one"
    assert names(path.parent) == ["a.txt"]


def test_a_file_may_be_read_by_whom_the_user_lets_read(tmp_path):
    (tmp_path / "plain").write_text("")
    with atomic_file(tmp_path / "a.txt") as temporary:
        temporary.touch(mode=0o600)
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_block_that_writes_nothing_changes_nothing(tmp_path):
    """As on a process that leaves writing to another one."""
    old, new = tmp_path / "old.txt", tmp_path / "new.txt"
    old.write_text("old")
    for path in (old, new):
        with atomic_file(path) as temporary:
            assert not temporary.exists()
    assert old.read_text() == "old"
    assert names(tmp_path) == ["old.txt"]


def test_of_several_processes_none_removes_what_another_writes(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    with atomic_file(path) as temporary:
        temporary.write_text("first")
        monkeypatch.setattr(os, "getpid", lambda: -1)
        with atomic_file(path):
            pass  # the other process has nothing to write
    assert path.read_text() == "first"


@pytest.mark.parametrize("stopped_by", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file(tmp_path, stopped_by):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with atomic_file(path) as temporary:
            temporary.write_text("half")
            raise stopped_by

    with pytest.raises(stopped_by):
        fail()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_where_nothing_can_be_written_is_said_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.txt", tmp_path):
        with pytest.raises(OSError, match="cannot be written"), atomic_file(path):
            pytest.fail("the block must not run")
    assert names(tmp_path) == ["file"]


def test_a_folder_takes_its_place_when_it_is_whole(tmp_path):
    with atomic_folder(tmp_path / "out") as temporary:
        (temporary / "a").write_text("one")
        assert names(tmp_path) == [temporary.name]
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "a").read_text() == "one"


def test_a_failure_leaves_no_folder(tmp_path):
    def fail() -> None:
        with atomic_folder(tmp_path / "out") as temporary:
            (temporary / "a").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert names(tmp_path) == []


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("")
    with pytest.raises(OSError, match="no empty folder"), atomic_folder(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert names(tmp_path / "out") == ["mine"]


READERS = {
    "image": lambda path: read_image(path, (4, 4)),
    "image size": image_size,
    "image end": lambda path: check_pixels(path, decode=False),
    "yaml": lambda path: read_yaml(path, str),
    "npz": read_npz,
    "pickle": read_pickled,
    "ply": read_ply,
    "record": read_text,
    "table": all_rows,
    "checkpoint": step_of,
    "colmap": lambda path: [*colmap.binary_camera_rows(path)],
    "colmap text": lambda path: [*colmap.text_camera_rows(path)],
}
"""Some of those that open files of others."""


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", ["pipe", "device", "socket"])
def test_nobody_waits_for_a_pipe_or_reads_a_device_without_end(name, kind, tmp_path):
    path = tmp_path / "000.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        with socket.socket(socket.AF_UNIX) as one, contextlib.chdir(tmp_path):
            one.bind(path.name)
    with pytest.raises((OSError, ValueError), match="is a pipe, a socket or a device, and no file: put"):
        READERS[name](path)


def test_files_folders_links_to_them_and_nothing_at_all_pass(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path)
    for path in (tmp_path / "link", tmp_path / "nothing", tmp_path):
        check_regular(path)
