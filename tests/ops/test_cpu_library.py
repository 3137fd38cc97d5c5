"""Which library is loaded."""

import pytest
import torch

from sparsestreet.ops import contribution, leave_one_out, splat
from sparsestreet.ops.activate import activate
from sparsestreet.ops.cpu import library
from sparsestreet.ops.cpu.library import (
    LIBRARY_VARIABLE,
    STATUS_OUT_OF_MEMORY,
    find_library,
    load_library,
    tile_size,
)
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.ops.ssim import ssim
from sparsestreet.types import Gaussians
from tests.ops.scenes import camera, random_gaussians

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


def activated() -> Gaussians:
    shapes = ((3,), (3,), (4,), (), (1, 3), (0, 3))
    means, scales, turns, opacities, dc, rest = (torch.ones(2, *shape, requires_grad=True) for shape in shapes)
    raw = RawGaussians(means, scales, turns, opacities, dc, rest)
    return activate([raw], sh_degree=0, backend="cpu")


CALLS = {
    "splat_forward": lambda: splat(random_gaussians(5, camera(9, 7)), camera(9, 7), backend="cpu"),
    "splat_contribution": lambda: contribution(random_gaussians(5, camera(9, 7)), camera(9, 7), backend="cpu"),
    "splat_leave_one_out": lambda: leave_one_out(random_gaussians(5, camera(9, 7)), camera(9, 7), backend="cpu"),
    "splat_activate": activated,
    "splat_ssim": lambda: ssim(torch.ones(11, 11, 3), torch.ones(11, 11, 3), backend="cpu"),
}


@pytest.mark.parametrize("function", CALLS)
def test_what_the_library_answers_is_looked_at(monkeypatch, function):
    monkeypatch.setattr(load_library(), function, lambda *_: STATUS_OUT_OF_MEMORY)
    with pytest.raises(MemoryError, match="no memory"):
        CALLS[function]()


def test_what_the_library_answers_backward_is_looked_at(monkeypatch):
    gaussians = random_gaussians(5, camera(9, 7))
    gaussians.means.requires_grad_()
    for function, output in (
        ("splat_backward", splat(gaussians, camera(9, 7), backend="cpu").rgb),
        ("splat_activate_backward", activated().means),
    ):
        monkeypatch.setattr(load_library(), function, lambda *_: STATUS_OUT_OF_MEMORY)
        with pytest.raises(MemoryError, match="no memory"):
            output.sum().backward()


def test_a_workspace_that_is_gone_is_not_lent_again():
    # The garbage collector may take a workspace before its lease.
    lease = library.Lease(torch.float64, library.FASTEST_VARIANT)
    gone = lease.workspace
    gone.__del__()
    del lease
    assert gone not in library.idle_workspaces()
