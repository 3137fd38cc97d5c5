"""What a record says of code and machine."""

import os
import platform
import subprocess
from pathlib import Path

import pytest

from sparsestreet.records import run
from sparsestreet.records.run import CodeVersion, Machine, processor_name, this_machine, this_source


def git(folder, *arguments):
    identity = ("-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false")
    answer = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return answer.stdout.strip()


def test_source_is_the_checkout_that_tracks_the_package(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "somebody else's repository")
    assert (this_source(package).commit, this_source(package).dirty) == (None, None)  # not tracked
    git(tmp_path, "add", "package")
    git(tmp_path, "commit", "-q", "-m", "first")
    commit = git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "notes").write_text("untracked files change nothing")
    assert (this_source(package).commit, this_source(package).dirty) == (commit, False)
    (package / "__init__.py").write_text("x = 1\n")
    assert (this_source(package).commit, this_source(package).dirty) == (commit, True)


def test_every_word_of_a_machine_is_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "processor_name", lambda: "a processor")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    monkeypatch.setattr(platform, "system", lambda: "Plan 9")
    monkeypatch.setattr(platform, "machine", lambda: "m68k")
    monkeypatch.setattr(platform, "python_version", lambda: "3.99")
    monkeypatch.setattr(run.metadata, "version", lambda package: f"{package} 7")
    assert this_machine() == Machine("a processor", 3, "Plan 9 m68k", "3.99", "torch 7")
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    assert this_machine().cores == 12
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert this_machine().cores == 1


@pytest.mark.parametrize(
    ("cpuinfo", "processor", "expected"),
    [
        ("processor\t: 0\nmodel name\t: Fast: 3 GHz \nmodel name\t: other\n", "p", "Fast: 3 GHz"),
        ("processor\t: 0\nBogoMIPS\t: 1\n", "p", "p"),
        (None, "", "m68k"),
    ],
)
def test_a_processor_is_its_model_or_its_kind(monkeypatch, cpuinfo, processor, expected):
    monkeypatch.setattr(Path, "exists", lambda path: cpuinfo is not None)
    monkeypatch.setattr(Path, "read_text", lambda path: cpuinfo)
    monkeypatch.setattr(platform, "processor", lambda: processor)
    monkeypatch.setattr(platform, "machine", lambda: "m68k")
    assert processor_name() == expected


def test_without_git_nobody_knows_the_commit(tmp_path, monkeypatch):
    def absent(command, **how):
        raise FileNotFoundError(command[0])

    monkeypatch.setattr(subprocess, "run", absent)
    assert this_source(tmp_path) == CodeVersion(None, None)
