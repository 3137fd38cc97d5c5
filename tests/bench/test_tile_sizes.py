"""Where no library can be compiled for another size of tiles, the sweep says why."""

import os
import shutil
import subprocess
from concurrent.futures import Future, ProcessPoolExecutor
from functools import cache

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


@pytest.mark.parametrize("fails", [None, 0, 1])
def test_a_library_is_configured_then_compiled_in_a_folder_of_its_own(monkeypatch, tmp_path, fails):
    size = 8 if tile_size() != 8 else 32
    (tmp_path / "CMakeLists.txt").touch()
    monkeypatch.setattr(tile_sizes, "ROOT", tmp_path)
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(tile_sizes.os, "cpu_count", lambda: 6)
    asked: list[list[str]] = []

    def run(command, cwd, capture_output, check):
        assert (cwd, capture_output, check) == (tmp_path, True, False)
        asked.append(command)
        return subprocess.CompletedProcess(command, 3 if len(asked) - 1 == fails else 0)

    monkeypatch.setattr(subprocess, "run", run)
    made = build.__wrapped__(size)
    folder = f".cache/tiles/{size}"
    commands = [
        ["cmake", "-S", ".", "-B", folder, f"-DSPARSESTREET_TILE={size}"],
        ["cmake", "--build", folder, "--parallel", "6"],
    ]
    assert asked == commands[: 2 if fails is None else fails + 1]
    if fails is None:
        assert made == Build(tmp_path / folder / tile_sizes.LIBRARY_NAME)
    else:
        said = f"status 3 of '{' '.join(commands[fails])}': run that in the checkout to see why"
        assert made == Build(None, said)
    build.__wrapped__(size)  # the folder is there already


def test_another_process_gets_library_threads_and_work(monkeypatch):
    """Each size and number of threads has one process."""
    asked: list[object] = []
    monkeypatch.setattr(tile_sizes, "build", lambda size: Build(ROOT / f"lib{size}.so"))

    class Pool(ProcessPoolExecutor):
        def __init__(self, workers, context, start, given):
            asked.append((workers, context.get_start_method(), start, given))

        def submit(self, function, request):
            done: Future[bytes] = Future()
            done.set_result(function(request))
            return done

    monkeypatch.setattr(tile_sizes, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(tile_sizes, "_process", cache(tile_sizes._process.__wrapped__))
    monkeypatch.setattr(tile_sizes.torch, "get_num_threads", lambda: 5)
    assert with_tiles(64, divmod, 17, 5) == (3, 2)
    assert with_tiles(64, divmod, 5, 17) == (0, 5)
    assert with_tiles(128, max, 1, 2) == 2
    assert asked == [(1, "spawn", tile_sizes._start, (str(ROOT / f"lib{size}.so"), 5)) for size in (64, 128)]
    numbers: list[int] = []
    monkeypatch.setattr(tile_sizes.torch, "set_num_threads", numbers.append)
    monkeypatch.setenv(tile_sizes.LIBRARY_VARIABLE, "old")
    tile_sizes._start("lib.so", 3)
    assert (os.environ[tile_sizes.LIBRARY_VARIABLE], numbers) == ("lib.so", [3])
