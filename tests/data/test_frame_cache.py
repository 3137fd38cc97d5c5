"""Frames in memory are the frames that were decoded, bit for bit, and no more than there is room for."""

import dataclasses
import itertools
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import lightning
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsestreet.data import frame_cache
from sparsestreet.data.datamodule import HOST, Draws, OrderedFrames, ShuffledFrames, StreetData
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.frame_cache import (
    THREAD_NAME,
    FrameCache,
    MemoryForecast,
    PackedFrame,
    Prefetcher,
    Returns,
    cache_bytes,
    prefetched,
)
from sparsestreet.data.lazy import Frames
from sparsestreet.data.problems import LogError
from sparsestreet.types import Camera, Frame
from tests.data.drivestudio.folders import make_nuscenes
from tests.data.plan import make_log
from tests.data.test_datamodule import Recorder, StopError, fit, keys

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
    frames = FrameCache(counting(asked), 2 * SIZE + 1)
    for _ in range(3):
        for key in (4, 5, 6, 7):
            assert_same(frames(key), frame_of(key))
    assert asked == [4, 5, 6, 7, 6, 7, 6, 7]
    assert frames.forecast([4, 5, 6, 7]) == MemoryForecast(2, 4, 2 * SIZE, 4 * SIZE)


@pytest.mark.parametrize(("room", "reads"), [(0, 4), (SIZE - 1, 4), (SIZE, 2)])
def test_room_for_none_and_for_one(room, reads):
    asked: list[int] = []
    frames = FrameCache(counting(asked), room)
    for key in (1, 2, 1, 1):
        frames(key)
    assert len(asked) == reads


def test_auto_keeps_frames_while_as_much_memory_stays_free(monkeypatch):
    """Eleven frames' worth are free, and what is kept is free no more: five are kept, for a sixth would leave five."""
    asked: list[int] = []
    frames = FrameCache(counting(asked), None)
    monkeypatch.setattr(frame_cache, "free_bytes", lambda: 11 * SIZE - SIZE * len(frames._kept))
    for key in range(12):
        frames(key)
    assert len(frames._kept) == 5
    assert frames.forecast(list(range(12))) == MemoryForecast(5, 12, 5 * SIZE, 12 * SIZE)


def test_the_forecast_reads_a_frame_if_none_was_read_yet():
    asked: list[int] = []
    frames = FrameCache(counting(asked), 100 * SIZE)
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

    frames = FrameCache(load, 10 * SIZE)
    with ThreadPoolExecutor(4) as executor:
        for frame in executor.map(frames, [3] * 4):
            assert_same(frame, frame_of(3))
    assert frames._used == SIZE


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX alone")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_forked_child_can_keep_frames_though_the_parent_was_about_to():
    frames = FrameCache(counting([]), 10 * SIZE)
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
    monkeypatch.setattr(frame_cache, "_SYSTEM", system)
    monkeypatch.setattr(frame_cache, "_OWN_GROUPS", own)
    monkeypatch.setattr(frame_cache, "_V2", dataclasses.replace(frame_cache._V2, root=root))
    monkeypatch.setattr(frame_cache, "_V1", dataclasses.replace(frame_cache._V1, root=tmp_path / "none"))
    assert frame_cache.free_bytes() == 8000 * 1024
    own.write_text("4:memory:/other\n0::/job_7/step_0\n")
    limited(root / "job_7/step_0", limit="max", used=100, files=0)
    assert frame_cache.free_bytes() == 8000 * 1024
    limited(root / "job_7", limit="5000000", used=1_000_000, files=200_000)
    assert frame_cache.free_bytes() == 4_200_000  # files that the system remembers go first
    limited(root / "job_7/step_0", limit="1000", used=2000, files=0)
    assert frame_cache.free_bytes() == 0
    system.unlink()
    assert frame_cache.free_bytes() is None


def test_the_first_version_of_groups_counts_too(tmp_path, monkeypatch):
    own, root = tmp_path / "cgroup", tmp_path / "memory"
    own.write_text("5:cpu:/x\n4:memory:/job\n0::/\n")
    monkeypatch.setattr(frame_cache, "_OWN_GROUPS", own)
    monkeypatch.setattr(frame_cache, "_V2", dataclasses.replace(frame_cache._V2, root=tmp_path / "none"))
    monkeypatch.setattr(frame_cache, "_V1", dataclasses.replace(frame_cache._V1, root=root))
    (root / "job").mkdir(parents=True)
    for name, text in (("limit_in_bytes", "4096"), ("usage_in_bytes", "96"), ("stat", "total_inactive_file 6")):
        (root / "job" / f"memory.{name}").write_text(text)
    assert frame_cache.free_bytes() == 4006


LOG = make_log(9, 2)


def all_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith(THREAD_NAME)}


@pytest.fixture
def threads() -> Callable[[], set[threading.Thread]]:
    """Those that read and have come since: another test's may live on where an error holds its loader."""
    others = all_threads()
    return lambda: all_threads() - others


def ahead_of(read, count: int | None = 2) -> Prefetcher:
    return Prefetcher(read, HOST, count)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_frames_come_in_their_order_whichever_is_ready_first(count, threads):
    """Every third one takes as long as the two behind it."""
    later = {draw: threading.Event() for draw in range(40)}

    def read(draw: int) -> Frame:
        if count > 1 and draw % 3 == 0 and draw < 30:
            assert later[draw + 1].wait(10)
        later[draw].set()
        return LOG.frames[draw % 18]

    ahead = ahead_of(read, count)
    assert [ahead.take(draw) for draw in range(30)] == [LOG.frames[draw % 18] for draw in range(30)]
    ahead.close()
    assert threads() == set()


def test_the_next_frames_are_read_before_they_are_asked_for():
    read, all_of_them = [], threading.Event()

    def noted(draw: int) -> Frame:
        read.append(draw)
        if len(read) == 4:
            all_of_them.set()
        return LOG.frames[draw]

    ahead = ahead_of(noted, 3)
    ahead.take(0)
    assert all_of_them.wait(10)  # the one that was taken, and one for each thread
    ahead.close()
    assert sorted(read) == [0, 1, 2, 3]


def test_nothing_is_read_beyond_the_end(threads):
    read = []
    ahead = ahead_of(lambda draw: read.append(draw) or LOG.frames[draw])
    assert [ahead.take(draw, 5) for draw in range(5)] == list(LOG.frames[:5])
    ahead.close()
    assert sorted(read) == [0, 1, 2, 3, 4]
    assert list(prefetched(LOG.frames, HOST)) == list(LOG.frames)
    assert threads() == set()


def test_an_error_comes_at_the_step_that_takes_the_frame_and_the_next_ones_are_there():
    def read(draw: int) -> Frame:
        if draw == 2:
            raise LogError([])
        return LOG.frames[draw]

    ahead = ahead_of(read)
    assert [ahead.take(draw).indices for draw in range(2)] == [(0, 0), (0, 1)]
    with pytest.raises(LogError):
        ahead.take(2)
    assert ahead.take(3).indices == (1, 1)
    ahead.close()


def test_another_place_is_taken_up_without_what_was_read_for_the_last_one():
    ahead = ahead_of(lambda draw: LOG.frames[draw])
    assert [ahead.take(draw).indices for draw in (0, 1, 10, 11, 4)] == [(0, 0), (0, 1), (5, 0), (5, 1), (2, 0)]
    ahead.close()


def test_threads_take_one_core_each_and_leave_the_others_their_number():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    inside = []
    try:
        ahead = ahead_of(lambda draw: inside.append(torch.get_num_threads()) or LOG.frames[draw])
        ahead.take(0)
        ahead.close()
        assert set(inside) == {1}
        assert torch.get_num_threads() == 3
        later: list[int] = []
        thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
        thread.start()
        thread.join()
        assert later == [3]  # torch tells new threads what it was told last
    finally:
        torch.set_num_threads(before)


def test_at_least_one_thread():
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        ahead_of(LOG.frames.load, 0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX alone")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_forked_child_reads_with_threads_of_its_own():
    loader = ShuffledFrames(LOG.frames, 0, threads=2)
    taken = keys(itertools.islice(loader, 3))
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends the child where it waits for threads that it does not have
        again = ShuffledFrames(LOG.frames, 0)
        os._exit(50 + (keys(itertools.islice(loader, 9)) == keys(itertools.islice(again, 12))[3:]))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 51
    assert len(taken) == 3
    loader.close()


def test_a_loader_that_is_dropped_leaves_no_thread(threads):
    """Without a cycle: the collector need not come by."""
    loader = ShuffledFrames(LOG.frames, 0)
    keys(itertools.islice(loader, 3))
    reading = threads()
    assert reading
    del loader
    for thread in reading:
        thread.join(10)
    assert threads() == set()


def test_an_epoch_ends_without_a_pause_of_the_reading():
    """The first frames of the next one are read with the last ones of this."""
    frames = Frames(LOG.frames.keys, lambda view: view)
    loader = ShuffledFrames(frames, 3, threads=2)
    first = keys(loader)
    assert len(loader._ahead._pending) == 2
    second = keys(loader)
    loader.close()
    other = ShuffledFrames(LOG.frames, 3)
    assert [first, second] == [keys(other), keys(other)]
    other.close()


def test_a_place_counts_frames_that_were_taken_not_those_that_were_read():
    loader = ShuffledFrames(LOG.frames, 0, threads=4)
    list(itertools.islice(loader, 2))
    assert loader.state_dict() == {"finished": 2}
    loader.close()


def test_validation_goes_the_same_way_and_leaves_no_thread(threads):
    loader = OrderedFrames(LOG.frames, 4)
    frames = iter(loader)
    assert next(frames).indices == (0, 0)
    assert threads()
    del frames
    assert threads() == set()
    assert keys(loader) == keys(LOG.frames.at((0, 6, 11, 17)))


class Stop(lightning.Callback):
    def __init__(self, error: BaseException, threads: Callable[[], set[threading.Thread]]) -> None:
        self.error, self.threads = error, threads

    def on_train_batch_end(self, trainer: lightning.Trainer, *arguments) -> None:
        assert self.threads()
        if trainer.global_step == 3:
            raise self.error


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
@pytest.mark.parametrize("error", [StopError(), KeyboardInterrupt(), SystemExit(143)])
def test_threads_end_with_a_training_however_it_ends(error, threads):
    data = StreetData(make_log(6, 1), stride=6, offset=2)
    if isinstance(error, StopError):
        fit(data, 4)
        assert threads() == set()
        fit(data, 9, callback=Stop(error, threads))
    else:
        with pytest.raises(SystemExit):  # Lightning's answer to both
            fit(data, 9, callback=Stop(error, threads))
    assert threads() == set()


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
def test_a_broken_image_ends_training_at_its_own_step_and_is_named(tmp_path, threads):
    make_nuscenes(tmp_path, frames=8, cameras=1)
    data = StreetData(DriveStudioReader(tmp_path).read(), stride=8, offset=5, seed=1)
    frames = data.split.train
    order = [frames.views[place].indices for place in Draws(len(frames), 1).order(0)]
    place, _ = order[3]
    assert place != 0  # which is read for the forecast
    path = Path(tmp_path / f"images/{place:03d}_0.jpg")
    path.write_bytes(path.read_bytes()[:40])
    done: list[Recorder] = []

    class Note(lightning.Callback):
        def on_fit_start(self, trainer: lightning.Trainer, module: Recorder) -> None:
            done.append(module)

    with pytest.raises(LogError, match=path.name):
        fit(data, 6, callback=Note())
    assert done[0].seen == order[:3]
    assert threads() == set()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_frames_arrive_before_they_are_taken():
    device = torch.device("cuda", 0)
    loader = ShuffledFrames(LOG.frames, 0, device=device)
    for frame in itertools.islice(loader, 40):
        here = next(one for one in LOG.frames if one.indices == frame.indices)
        assert frame.image.device == device
        assert torch.equal(frame.image.cpu(), here.image)
    loader.close()


def test_what_a_training_says_of_its_memory(tmp_path, caplog):
    make_nuscenes(tmp_path, frames=4, cameras=1)
    with caplog.at_level("INFO", "sparsestreet.data.datamodule"):
        StreetData(DriveStudioReader(tmp_path, cache_mb=1).read(), stride=0).train_dataloader()
        StreetData(make_log(), stride=0).train_dataloader()  # frames that are in memory anyway
    assert [record.message for record in caplog.records] == [
        "all 4 frames stay in memory once they are decoded (0.00 GB)"
    ]
