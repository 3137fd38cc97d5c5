"""The program as a shell calls it."""

import os
import subprocess
import sys

import pytest

from sparsestreet.cli import READER_GONE

PROGRAM = [sys.executable, "-m", "sparsestreet"]


@pytest.mark.parametrize("words", [["--help"], ["render", "--help"]])
def test_a_reader_that_has_enough_ends_it_quietly(words):
    """As ``| head -1`` does."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([*PROGRAM, *words], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (READER_GONE, "")


def test_an_unknown_command_is_named(capfd):
    assert subprocess.run([*PROGRAM, "trian"], check=False).returncode == 2
    assert "no command 'trian'; did you mean 'train'?" in capfd.readouterr().err
