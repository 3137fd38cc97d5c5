"""Threads read the frames that come next; order, errors and ends are those of a loop that reads them itself."""

import itertools
import os
import signal
import threading
from pathlib import Path

import lightning
import pytest
import torch

from sparsestreet.data.ahead import NAME, ReadAhead, read_ahead
from sparsestreet.data.datamodule import HOST, OrderedFrames, ShuffledFrames, StreetData
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.lazy import Frames
from sparsestreet.data.problems import LogError
from sparsestreet.types import Frame
from tests.data.drivestudio.folders import make_nuscenes
from tests.data.streets import make_log
from tests.data.test_datamodule import Recorder, StopError, fit, keys

LOG = make_log(9, 2)


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith(NAME)]


def ahead_of(read, count: int | None = 2) -> ReadAhead:
    return ReadAhead(read, HOST, count)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_frames_come_in_their_order_whichever_is_ready_first(count):
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
    assert threads() == []


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


def test_nothing_is_read_beyond_the_end():
    read = []
    ahead = ahead_of(lambda draw: read.append(draw) or LOG.frames[draw])
    assert [ahead.take(draw, 5) for draw in range(5)] == list(LOG.frames[:5])
    ahead.close()
    assert sorted(read) == [0, 1, 2, 3, 4]
    assert list(read_ahead(LOG.frames, HOST)) == list(LOG.frames)
    assert threads() == []


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


def test_validation_goes_the_same_way_and_leaves_no_thread():
    loader = OrderedFrames(LOG.frames, 4)
    frames = iter(loader)
    assert next(frames).indices == (0, 0)
    assert threads()
    del frames
    assert threads() == []
    assert keys(loader) == keys(LOG.frames.at((0, 6, 11, 17)))


class Stop(lightning.Callback):
    def __init__(self, error: BaseException) -> None:
        self.error = error

    def on_train_batch_end(self, trainer: lightning.Trainer, *arguments) -> None:
        assert threads()
        if trainer.global_step == 3:
            raise self.error


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
@pytest.mark.parametrize("error", [StopError(), KeyboardInterrupt(), SystemExit(143)])
def test_threads_end_with_a_training_however_it_ends(error, monkeypatch):
    data = StreetData(make_log(6, 1), stride=6, offset=2)
    if isinstance(error, StopError):
        fit(data, 4)
        assert threads() == []
        fit(data, 9, callback=Stop(error))
    else:
        with pytest.raises(SystemExit):  # Lightning's answer to both
            fit(data, 9, callback=Stop(error))
    assert threads() == []


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
def test_a_broken_image_ends_training_at_its_own_step_and_is_named(tmp_path):
    make_nuscenes(tmp_path, frames=8, cameras=1)
    data = StreetData(DriveStudioReader(tmp_path).read(), stride=8, offset=5, seed=1)
    frames = data.split.train
    order = [frames.views[place].indices for place in ShuffledFrames(frames, 1)._order(0)]
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
    assert threads() == []


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
