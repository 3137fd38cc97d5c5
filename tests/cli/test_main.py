"""The program as a shell calls it."""

import os
import subprocess
import sys
from dataclasses import dataclass

import pytest

from sparsestreet.cli import READER_GONE, main
from sparsestreet.cli.commands.options import run_command

PROGRAM = [sys.executable, "-m", "sparsestreet"]


@pytest.mark.parametrize("words", [["--help"], ["render", "--help"]])
def test_a_reader_that_has_enough_ends_it_quietly(words):
    """As ``| head -1`` does."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([*PROGRAM, *words], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (READER_GONE, "")


def test_a_table_that_nobody_reads_ends_quietly(finished, tmp_path, capfd, monkeypatch):
    """Its last lines come while pictures are made, and are written at once."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        with pytest.raises(SystemExit) as ended:
            main(["objects", str(finished), f"out={tmp_path / 'sheet.png'}"])
    assert ended.value.code == READER_GONE
    assert capfd.readouterr().err == ""


def test_a_broken_pipe_of_another_program_is_told(capsys, monkeypatch):
    @dataclass(frozen=True)
    class Nothing:
        word: str

    def break_pipe(nothing):
        raise BrokenPipeError(32, "ffmpeg ended")

    read, write = os.pipe()
    with open(read), open(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert run_command("render", "usage", ["word=x"], Nothing, break_pipe) == 1
    assert "ffmpeg ended" in capsys.readouterr().err


def test_an_unknown_command_is_named(capfd):
    assert subprocess.run([*PROGRAM, "trian"], check=False).returncode == 2
    assert "no command 'trian'; did you mean 'train'?" in capfd.readouterr().err
