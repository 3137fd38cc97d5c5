"""Locks of folders and devices: one holder, none after its death."""

import os
import signal
import socket
import subprocess
import sys

import pytest

from sparsestreet.cli.runs.locks import LOCK, FolderTakenError, acquire, release, sole_writer


def test_a_second_writer_is_told_who_the_first_is_and_touches_nothing(tmp_path):
    out = tmp_path / "run"
    with sole_writer(out):
        (out / "scene").write_text("whole")
        said = rf"run is being written by process {os.getpid()} on .*: wait for that run, end it, or name another place"
        with pytest.raises(FolderTakenError, match=said), sole_writer(out):
            pytest.fail("two write")
        assert sorted(path.name for path in out.iterdir()) == [LOCK, "scene"]
    assert [path.name for path in out.iterdir()] == ["scene"]
    with sole_writer(out):
        pass


def test_who_writes_is_not_mixed_with_who_was_killed_there(tmp_path):
    (tmp_path / LOCK).write_text("process 1234567890 on a-computer-with-a-very-long-name.of.a.lab.of.a.university")
    with sole_writer(tmp_path):
        assert (tmp_path / LOCK).read_text() == f"process {os.getpid()} on {socket.gethostname()}"


def test_a_failed_writer_leaves_no_lock(tmp_path):
    with pytest.raises(ValueError, match="broken"), sole_writer(tmp_path):
        raise ValueError("broken")
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    """Its file is still there; a link in its place is no way to another file."""
    code = "import sys, time; from sparsestreet.cli.runs.locks import acquire; from pathlib import Path; "
    code += "acquire(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    path = tmp_path / "slot"
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    assert acquire(path) is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert path.exists()
    held = acquire(path)
    assert held is not None
    release(path, held)
    assert not path.exists()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="slot"):
        acquire(path)
    assert not (tmp_path / "elsewhere").exists()


def test_a_lock_whose_file_was_removed_in_between_is_taken_anew(tmp_path, monkeypatch):
    """Its holder removes the file as it lets go: who waited for the old one holds a file that nobody finds."""
    path, flock, taken = tmp_path / "slot", __import__("fcntl").flock, []

    def late(descriptor: int, how: int) -> None:
        flock(descriptor, how)
        if not taken:
            path.unlink()
        taken.append(descriptor)

    monkeypatch.setattr("fcntl.flock", late)
    held = acquire(path)
    assert held is not None
    assert len(taken) == 2
    assert acquire(path) is None
    release(path, held)
