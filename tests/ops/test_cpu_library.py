"""Which library is loaded."""

import pytest
import torch

from sparsestreet.ops.cpu import library, workspace
from sparsestreet.ops.cpu.library import LIBRARY_VARIABLE, find_library, load_library, tile_size

find = find_library.__wrapped__  # without its cache


def test_a_variable_names_another_library(monkeypatch, tmp_path):
    other = tmp_path / "other.so"
    other.write_bytes(b"")
    monkeypatch.setenv(LIBRARY_VARIABLE, str(other))
    assert find() == other


def test_a_variable_that_names_no_file(monkeypatch, tmp_path):
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path))
    with pytest.raises(RuntimeError, match=f"{LIBRARY_VARIABLE} names no file: .*unset it"):
        find()


@pytest.mark.parametrize("files", [None, []])
def test_no_library_is_built(monkeypatch, files):
    # None: a package without a record of its files.
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)
    monkeypatch.setattr(library, "LIBRARY_NAME", "no_such_library.so")
    monkeypatch.setattr(library.importlib.metadata, "files", lambda name: files)
    assert find() is None


def test_the_library_reports_its_tiles():
    assert tile_size() == load_library().splat_tile_size()
    assert tile_size() in (8, 16, 32)


def test_a_workspace_that_is_gone_is_not_lent_again():
    # The garbage collector may take a workspace before its lease.
    lease = workspace.Lease(torch.float64, workspace.FASTEST_VARIANT)
    gone = lease.workspace
    gone.__del__()
    del lease
    assert gone not in workspace.idle_workspaces()
