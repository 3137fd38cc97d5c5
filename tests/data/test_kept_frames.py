"""Frames in memory are the frames that were decoded, bit for bit, and no more than there is room for."""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsestreet.data import free_memory, kept_frames
from sparsestreet.data.kept_frames import KeptFrames, MemoryForecast, cache_bytes
from sparsestreet.data.packed import PackedFrame, Returns
from sparsestreet.types import Camera, Frame

MASKS = ("sky", "human", "vehicle", "ego")
GB = 1_000_000_000


def frame_of(seed: int, height: int = 6, width: int = 7, masks: tuple[str, ...] = MASKS, returns: int = 3) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    depth = torch.zeros(height, width)
    depth.view(-1)[torch.randperm(height * width, generator=generator)[:returns]] = 5.0
    camera = Camera(torch.eye(4), torch.eye(3), width, height)
    return Frame(
        camera,
        0.25,
        seed,
        1,
        seconds=2.5,
        stamp=7,
        image=torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8),
        depth=depth,
        **{name: torch.rand(height, width, generator=generator) < 0.5 for name in masks},
    )


def assert_same(frame: Frame, other: Frame) -> None:
    for field in dataclasses.fields(Frame):
        value, again = getattr(frame, field.name), getattr(other, field.name)
        if isinstance(value, torch.Tensor):
            assert value.dtype == again.dtype
            assert value.numpy().tobytes() == again.numpy().tobytes()
            assert value.shape == again.shape
        elif isinstance(value, Camera):
            assert (value.width, value.height) == (again.width, again.height)
        else:
            assert value == again


@settings(deadline=None)  # the first example pays for what is built once
@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.lists(st.sampled_from(MASKS), unique=True),
    st.one_of(st.none(), st.integers(0, 81)),
)
def test_a_packed_frame_is_the_frame(height, width, masks, returns):
    """Sizes that are no multiples of eight pixels, too."""
    frame = frame_of(1, height, width, tuple(masks), min(returns or 0, height * width))
    if returns is None:
        frame = dataclasses.replace(frame, depth=None)
    assert_same(PackedFrame.of(frame).frame(), frame)


def test_every_bit_of_a_depth_stays():
    """A -0 equals 0, and a NaN equals nothing."""
    depth = torch.zeros(20, 20)
    depth[3, 4], depth[5, 6], depth[7, 8] = -0.0, torch.nan, torch.inf
    packed = Returns.of(depth)
    assert isinstance(packed, Returns)
    assert packed.image((20, 20)).numpy().tobytes() == depth.numpy().tobytes()


def test_a_dense_depth_is_kept_as_it_is():
    depth = torch.ones(4, 4)
    assert Returns.of(depth) is depth
    depth.view(-1)[:9] = 0  # seven returns of eight bytes take less than sixteen of four
    assert isinstance(Returns.of(depth), Returns)


def test_600_frames_of_960x640_take_less_than_3_gb():
    """Four masks, and a lidar whose sweep of 150,000 returns five cameras share."""
    packed = PackedFrame.of(frame_of(0, 640, 960, returns=30_000))
    assert packed.nbytes == 640 * 960 * 3 + 640 * 960 * 4 // 8 + 30_000 * 8
    assert 600 * packed.nbytes < 3 * GB


def counting(asked: list[int]):
    def load(key):
        asked.append(key)
        return frame_of(key)

    return load


SIZE = PackedFrame.of(frame_of(0)).nbytes


def test_what_came_first_stays_and_the_rest_is_read_each_time():
    asked: list[int] = []
    frames = KeptFrames(counting(asked), 2 * SIZE + 1)
    for _ in range(3):
        for key in (4, 5, 6, 7):
            assert_same(frames(key), frame_of(key))
    assert asked == [4, 5, 6, 7, 6, 7, 6, 7]
    assert frames.forecast([4, 5, 6, 7]) == MemoryForecast(2, 4, 2 * SIZE, 4 * SIZE)


@pytest.mark.parametrize(("room", "reads"), [(0, 4), (SIZE - 1, 4), (SIZE, 2)])
def test_room_for_none_and_for_one(room, reads):
    asked: list[int] = []
    frames = KeptFrames(counting(asked), room)
    for key in (1, 2, 1, 2)[: 4 if room < SIZE else 2] + (() if room < SIZE else (1, 1)):
        frames(key)
    assert len(asked) == reads


def test_auto_keeps_frames_while_as_much_memory_stays_free(monkeypatch):
    """Eleven frames' worth are free, and what is kept is free no more: five are kept, for a sixth would leave five."""
    asked: list[int] = []
    frames = KeptFrames(counting(asked), None)
    monkeypatch.setattr(kept_frames, "free_bytes", lambda: 11 * SIZE - SIZE * len(frames._kept))
    for key in range(12):
        frames(key)
    assert len(frames._kept) == 5
    assert frames.forecast(list(range(12))) == MemoryForecast(5, 12, 5 * SIZE, 12 * SIZE)


def test_processes_that_read_side_by_side_share_the_memory(monkeypatch):
    """Three of them, in turns: each keeps a quarter, and a quarter stays free."""
    all_of_them = [KeptFrames(counting([]), None) for _ in range(3)]
    monkeypatch.setattr(kept_frames, "free_bytes", lambda: 40 * SIZE - SIZE * sum(len(f._kept) for f in all_of_them))
    for key in range(40):
        for frames in all_of_them:
            frames(key)
    assert [len(frames._kept) for frames in all_of_them] == pytest.approx([10] * 3, abs=1)


def test_the_forecast_reads_a_frame_if_none_was_read_yet():
    asked: list[int] = []
    frames = KeptFrames(counting(asked), 100 * SIZE)
    forecast = frames.forecast([8, 9, 10])
    assert (forecast, asked) == (MemoryForecast(3, 3, 3 * SIZE, 3 * SIZE), [8])
    frames(8)
    assert asked == [8]


def test_the_forecast_in_words():
    assert str(MemoryForecast(600, 600, 1_440_000_000, 1_440_000_000)) == (
        "all 600 frames stay in memory once they are decoded (1.44 GB)"
    )
    some = str(MemoryForecast(200, 600, 480_000_000, 1_440_000_000))
    assert some.startswith("200 of 600 frames stay in memory once they are decoded (0.48 of 1.44 GB), the others are")
    assert "data.log.cache_mb" in some


def test_threads_that_read_one_frame_keep_it_once():
    meet = Barrier(4, timeout=10)

    def load(key):
        meet.wait()
        return frame_of(key)

    frames = KeptFrames(load, 10 * SIZE)
    with ThreadPoolExecutor(4) as executor:
        for frame in executor.map(frames, [3] * 4):
            assert_same(frame, frame_of(3))
    assert frames._used == SIZE


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX alone")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_forked_child_can_keep_frames_though_the_parent_was_about_to():
    frames = KeptFrames(counting([]), 10 * SIZE)
    with frames._lock:
        child = os.fork()
        if child == 0:
            frames(1)
            os._exit(40 + len(frames._kept))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 41


def test_the_size_of_the_cache():
    assert (cache_bytes("auto"), cache_bytes(3), cache_bytes(0)) == (None, 3_000_000, 0)
    with pytest.raises(ValueError, match="cache_mb must be a number of MB, 0 or more, or auto, got -1"):
        cache_bytes(-1)


def limited(root, *, limit: str, used: int, files: int):
    root.mkdir(parents=True, exist_ok=True)
    (root / "memory.max").write_text(limit + "\n")
    (root / "memory.current").write_text(f"{used}\n")
    (root / "memory.stat").write_text(f"anon 5\ninactive_file {files}\n")


def test_free_memory_is_what_the_machine_and_every_group_around_leave(tmp_path, monkeypatch):
    system, own, root = tmp_path / "meminfo", tmp_path / "cgroup", tmp_path / "fs"
    system.write_text("MemTotal:       9000 kB\nMemAvailable:   8000 kB\nHugePages_Total:       0\n")
    monkeypatch.setattr(free_memory, "_SYSTEM", system)
    monkeypatch.setattr(free_memory, "_OWN_GROUPS", own)
    monkeypatch.setattr(free_memory, "_V2", dataclasses.replace(free_memory._V2, root=root))
    monkeypatch.setattr(free_memory, "_V1", dataclasses.replace(free_memory._V1, root=tmp_path / "none"))
    assert free_memory.free_bytes() == 8000 * 1024
    own.write_text("4:memory:/other\n0::/job_7/step_0\n")
    limited(root / "job_7/step_0", limit="max", used=100, files=0)
    assert free_memory.free_bytes() == 8000 * 1024
    limited(root / "job_7", limit="5000000", used=1_000_000, files=200_000)
    assert free_memory.free_bytes() == 4_200_000  # files that the system remembers go first
    limited(root / "job_7/step_0", limit="1000", used=2000, files=0)
    assert free_memory.free_bytes() == 0
    system.unlink()
    assert free_memory.free_bytes() is None


def test_the_first_version_of_groups_counts_too(tmp_path, monkeypatch):
    own, root = tmp_path / "cgroup", tmp_path / "memory"
    own.write_text("5:cpu:/x\n4:memory:/job\n0::/\n")
    monkeypatch.setattr(free_memory, "_OWN_GROUPS", own)
    monkeypatch.setattr(free_memory, "_V2", dataclasses.replace(free_memory._V2, root=tmp_path / "none"))
    monkeypatch.setattr(free_memory, "_V1", dataclasses.replace(free_memory._V1, root=root))
    (root / "job").mkdir(parents=True)
    for name, text in (("limit_in_bytes", "4096"), ("usage_in_bytes", "96"), ("stat", "total_inactive_file 6")):
        (root / "job" / f"memory.{name}").write_text(text)
    assert free_memory.free_bytes() == 4006
