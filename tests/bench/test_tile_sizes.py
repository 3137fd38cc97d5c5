"""Where no library can be compiled for another size of tiles, the sweep says why."""

import shutil
import subprocess

import pytest

from sparsestreet.bench import sweep, tile_sizes
from sparsestreet.bench.knobs import DEFAULT, Point
from sparsestreet.bench.scenes import Size, bench_scenes
from sparsestreet.bench.tile_sizes import ROOT, Build, build, with_tiles
from sparsestreet.bench.timing import TimingBudget
from sparsestreet.ops.cpu.library import tile_size
from tests.typed import there

ONCE = TimingBudget(repeats=2, seconds=0.0, least=1)


def test_the_library_in_use_is_not_compiled_again(monkeypatch):
    monkeypatch.setattr(subprocess, "run", None)
    assert build.__wrapped__(tile_size()).library.is_file()


def test_a_size_that_cannot_be_compiled_says_why(monkeypatch, tmp_path):
    size = 8 if tile_size() == 16 else 16
    monkeypatch.setattr(tile_sizes, "ROOT", tmp_path)
    assert "without" in there(build.__wrapped__(size).missing)
    (tmp_path / "CMakeLists.txt").write_text("no such command\n")
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "which", lambda name: None)
        assert "no cmake" in there(build.__wrapped__(size).missing)
    if shutil.which("cmake") is not None:
        made = build.__wrapped__(size)
        assert made.library is None
        assert f"status 1 of 'cmake -S . -B .cache/tiles/{size}" in there(made.missing)


def test_without_a_library_the_point_is_skipped_with_its_reason(monkeypatch):
    for module in (sweep, tile_sizes):
        monkeypatch.setattr(module, "build", lambda size: Build(None, f"no compiler for {size}"))
    scene = bench_scenes(Size(48, 32, 120))[0]
    record = sweep.measure_point(scene, Point("tile size", "64", DEFAULT, tile=64), sweep.Truths(scene), ONCE)
    assert (record.skipped, record.times, record.tiles_in_use) == ("no compiler for 64", None, None)
    with pytest.raises(RuntimeError, match="no library with tiles of 64 pixels: no compiler for 64"):
        with_tiles(64, tile_size)


@pytest.mark.lengthy
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cmake_refuses_other_sizes(tmp_path):
    command = ["cmake", "-S", str(ROOT), "-B", str(tmp_path), "-DSPARSESTREET_TILE=12"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode != 0
    assert "SPARSESTREET_TILE must be 8, 16 or 32, got '12'" in answer.stderr
