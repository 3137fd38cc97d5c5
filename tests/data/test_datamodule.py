"""Order, repeatability and the trip to the device."""

import dataclasses
import itertools
import typing
from pathlib import Path
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import torch

from sparsestreet.data.datamodule import HOST, ShuffledFrames, StreetData
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.frame_cache import to_device
from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.ranks import Ranks
from sparsestreet.types import Frame, View
from tests.data.drivestudio.folders import make_nuscenes
from tests.data.plan import make_log
from tests.training.stubs import frame_at


def keys(frames) -> list[tuple[int, int]]:
    return [(frame.frame_index, frame.camera_index) for frame in frames]


def test_an_epoch_is_every_training_frame_once_in_a_new_order():
    data = StreetData(make_log(), stride=4, offset=1, seed=3)
    loader = data.train_dataloader()
    first, second = keys(loader), keys(loader)
    assert len(loader) == len(first) == 18
    assert sorted(first) == sorted(second) == keys(data.split.train)
    assert len({tuple(keys(data.split.train)), *map(tuple, (first, second, keys(loader), keys(loader)))}) == 5


@pytest.mark.parametrize(("size", "accumulated"), [(1, 3), (3, 1), (2, 2)])
def test_processes_take_turns_in_the_order_of_one(size, accumulated):
    """Seven frames, which no number divides: no step ends with an epoch, and none has a frame of its own order."""
    frames = as_frames([frame_at(index) for index in range(7)])
    alone = ShuffledFrames(frames, 3)
    images = [frame.frame_index for _ in range(4 * size * accumulated) for frame in alone]
    several = [ShuffledFrames(frames, 3, ranks=Ranks(rank, size), accumulated=accumulated) for rank in range(size)]
    parts = [[frame.frame_index for _ in range(3) for frame in loader] for loader in several]
    assert {len(part) for part in parts} == {3 * 7 * accumulated} == {3 * len(several[0])}
    turns = [frame for turn in zip(*parts, strict=True) for frame in turn]
    assert turns == images[: len(turns)]


@pytest.mark.parametrize("with_replacement", [False, True])
@pytest.mark.parametrize(("size", "accumulated"), [(1, 1), (3, 1), (2, 2)])
def test_last_draws_are_those_after_which_no_process_draws_the_frame_again(size, accumulated, with_replacement):
    frames = as_frames([frame_at(index) for index in range(7)])
    options = {"accumulated": accumulated, "with_replacement": with_replacement}
    several = [ShuffledFrames(frames, 3, ranks=Ranks(rank, size), **options) for rank in range(size)]
    parts = [[frame.frame_index for _ in range(3) for frame in loader] for loader in several]
    turns = [frame for turn in zip(*parts, strict=True) for frame in turn]
    for end in (1, 5, 7, 11, 20):
        seen = turns[: end * size]
        expected = [number for number, frame in enumerate(seen) if frame not in seen[number + 1 :]]
        for rank, loader in enumerate(several):
            assert loader.last_draws(end) == {number // size for number in expected if number % size == rank}


def test_a_process_goes_on_at_its_own_place():
    frames = as_frames([frame_at(index) for index in range(7)])
    whole = list(ShuffledFrames(frames, 3, ranks=Ranks(1, 2)))
    resumed = ShuffledFrames(frames, 3, ranks=Ranks(1, 2))
    resumed.load_state_dict({"finished": 4})
    assert keys(resumed) == keys(whole[4:])


def test_a_step_that_accumulates_finishes_all_of_its_images():
    data = StreetData(make_log(), stride=4, offset=1)
    data.trainer = typing.cast(
        lightning.Trainer,
        SimpleNamespace(global_step=4, accumulate_grad_batches=3, strategy=SimpleNamespace(root_device=HOST)),
    )
    assert data.train_dataloader().state_dict() == {"finished": 12}
    assert len(data.train_dataloader()) == 3 * 18


def test_the_order_is_given_by_the_seed_and_the_global_generator_stays():
    log = make_log()
    torch.manual_seed(5)
    before = torch.get_rng_state()
    orders = [keys(StreetData(log, seed=seed).train_dataloader()) for seed in (0, 0, 1)]
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(6)
    assert orders[0] == orders[1] != orders[2]
    second_of_zero = StreetData(log, seed=0).train_dataloader()
    list(second_of_zero)
    assert keys(second_of_zero) != orders[2]  # the second epoch of one seed is not the first of the next


def test_held_out_frames_come_in_order_every_time():
    loader = StreetData(make_log(), stride=4, offset=1).val_dataloader()
    assert keys(loader) == keys(loader) == [(index, camera) for index in (1, 5, 9) for camera in range(2)]
    assert len(loader) == 6


@pytest.mark.parametrize("limit", [1, 2, 12, 59, 61])
def test_validation_looks_at_frames_from_the_whole_drive(limit):
    """60 held-out images of 20 instants: the gaps differ by one at most, and from two on both ends are among them."""
    data = StreetData(make_log(200, 3), stride=10, offset=5, val_frames=limit)
    loader = data.val_dataloader()
    everything = keys(data.split.held_out)
    places = [everything.index(key) for key in keys(loader)]
    assert len(loader) == len(places) == min(limit, 60)
    gaps = {after - before for before, after in itertools.pairwise(places)}
    assert not gaps or max(gaps) - min(gaps) <= 1
    assert {places[0], places[-1]} == ({29} if limit == 1 else {0, 59})


@pytest.mark.lengthy
@pytest.mark.parametrize("num_cameras", [2, 3, 5])
def test_validation_meets_every_camera(num_cameras):
    """Also where every k-th held-out image would be of one camera."""
    data = StreetData(make_log(12 * num_cameras * 10, num_cameras), stride=10, offset=5, val_frames=12)
    assert len(data.split.held_out) == 12 * num_cameras**2
    assert {camera for _, camera in keys(data.val_dataloader())} == set(range(num_cameras))


def test_choosing_what_to_validate_decodes_nothing_and_needs_an_image():
    def load(view: View) -> Frame:
        raise AssertionError("decoded")

    log = make_log(40)
    data = StreetData(dataclasses.replace(log, frames=Frames(log.views, load)), val_frames=2)
    assert len(data.val_dataloader()) == 2
    with pytest.raises(ValueError, match="at least 1, got 0"):
        StreetData(log, val_frames=0)


@pytest.mark.parametrize("steps", [0, 5, 18, 20, 40])
def test_a_restored_loader_goes_on_where_the_saved_one_stopped(steps):
    frames = make_log(9).frames

    def stream(loader):
        return itertools.chain.from_iterable(itertools.repeat(loader))

    whole = ShuffledFrames(frames, 0)
    keys(itertools.islice(stream(whole), steps))
    state = whole.state_dict()
    expected = keys(itertools.islice(stream(whole), 25))
    resumed = ShuffledFrames(frames, 0)
    resumed.load_state_dict(state)
    assert keys(itertools.islice(stream(resumed), 25)) == expected


def test_a_frame_moves_with_its_tensors_but_the_camera_stays():
    frame = make_log(1).frames[0]
    moved = StreetData(make_log(), stride=0).transfer_batch_to_device(frame, torch.device("meta"), 0)
    assert isinstance(moved, Frame)
    assert {moved.image.device, moved.sky.device} == {torch.device("meta")}
    assert moved.camera is frame.camera
    assert (moved.depth, moved.frame_index, moved.time, moved.camera.width) == (None, 0, 0.0, 5)
    assert frame.image.device == torch.device("cpu")
    copy = to_device(frame, torch.device("cpu"))
    assert torch.equal(copy.image, frame.image)
    assert torch.equal(copy.sky, frame.sky)
    assert (copy.image.dtype, copy.sky.dtype) == (torch.uint8, torch.bool)


class Recorder(lightning.LightningModule):
    """Learns nothing; remembers the frames of the updates that it made."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[tuple[int, int]] = []
        self.validated: list[tuple[int, int]] = []

    def training_step(self, batch: Frame, batch_index: int) -> torch.Tensor:
        self.key = keys([batch])
        return self.weight * batch.image.float().mean()

    def optimizer_step(self, *arguments, **options) -> None:
        super().optimizer_step(*arguments, **options)
        self.seen += self.key

    def validation_step(self, batch: Frame, batch_index: int) -> None:
        self.validated += keys([batch])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


class StopError(Exception):
    """What interrupts a training in these tests."""


class Interruption(lightning.Callback):
    """Raises at a moment of a step, which is counted from 1, and leaves a checkpoint to go on from."""

    def __init__(self, moment: str, step: int, checkpoint: Path) -> None:
        self.checkpoint = checkpoint
        setattr(self, moment, self._stop)
        self._updates = step - 1 if moment in BEFORE_UPDATE else step

    def _stop(self, trainer: lightning.Trainer, *arguments) -> None:
        if trainer.global_step == self._updates:
            raise StopError

    def on_exception(self, trainer: lightning.Trainer, module: Recorder, exception: BaseException) -> None:
        trainer.save_checkpoint(self.checkpoint)


def fit(
    data: StreetData, steps: int, checkpoint: Path | None = None, callback: lightning.Callback | None = None
) -> tuple[Recorder, lightning.Trainer]:
    model = Recorder()
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        callbacks=callback,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        val_check_interval=3,
        check_val_every_n_epoch=None,
    )
    try:
        trainer.fit(model, data, ckpt_path=checkpoint)
    except StopError:
        assert callback is not None
    return model, trainer


def small_street() -> StreetData:
    return StreetData(make_log(6, 1), stride=6, offset=2)


# Lightning 2.6 asks torch about tree leaves in a way that torch 2.13 has deprecated.
@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
@pytest.mark.parametrize("steps", [5, 7])
def test_lightning_resumes_with_the_frames_that_were_left(steps, tmp_path):
    """Epochs have 5 frames, so that 7 steps end within one and 5 at its end."""
    whole, _ = fit(small_street(), 12)
    assert len(whole.seen) == 12
    assert set(whole.validated) == {(2, 0)}
    first, trainer = fit(small_street(), steps)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    second, _ = fit(small_street(), 12, tmp_path / "last.ckpt")
    assert first.seen + second.seen == whole.seen


BEFORE_UPDATE = ("on_train_batch_start", "on_after_backward")
MOMENTS = [
    *itertools.product((*BEFORE_UPDATE, "on_train_batch_end"), (1, 3, 5, 6, 9, 10, 11)),
    *itertools.product(("on_validation_start",), (3, 6, 9)),
]


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
@pytest.mark.parametrize(("moment", "step"), MOMENTS)
def test_a_training_interrupted_anywhere_in_a_step_goes_on_as_if_it_had_not_been(moment, step, tmp_path):
    """A step whose update was made is not made again, one whose update was not is made with the same frame."""
    whole, _ = fit(small_street(), 12)
    checkpoint = tmp_path / "interrupted.ckpt"
    first, _ = fit(small_street(), 12, callback=Interruption(moment, step, checkpoint))
    assert len(first.seen) == (step - 1 if moment in BEFORE_UPDATE else step)
    second, _ = fit(small_street(), 12, checkpoint)
    assert first.seen + second.seen == whole.seen


def test_with_replacement_a_frame_comes_at_any_step_and_a_resume_draws_the_same():
    frames = make_log(9).frames
    loader = ShuffledFrames(frames, 0, with_replacement=True)
    drawn = [key for _ in range(40) for key in keys(loader)]
    assert len(drawn) == 40 * len(frames)
    epochs = [drawn[start : start + len(frames)] for start in range(0, len(drawn), len(frames))]
    # Of n draws from n frames a share of 1 - (1 - 1/n)^n differ: 0.64 for n = 18, standard deviation 0.013 here.
    assert sum(len(set(epoch)) for epoch in epochs) / len(drawn) == pytest.approx(0.64, abs=0.05)
    assert set(drawn) == set(keys(frames))
    resumed = ShuffledFrames(frames, 0, with_replacement=True)
    resumed.load_state_dict({"finished": len(frames) + 4})
    assert keys(resumed) == epochs[1][4:]
    again = StreetData(make_log(9), stride=0, with_replacement=True).train_dataloader()
    assert keys(again) == epochs[0]


def test_a_camera_that_is_held_out_gives_returns_no_colors(tmp_path):
    """Images of one gray each, so that a color says which camera it is from."""
    log = DriveStudioReader(make_nuscenes(tmp_path)).read()
    assert len(log.camera_names) == 2
    data = StreetData(log, stride=0, cameras=["0"])
    assert data.split_in_words == "camera 0"
    alone = DriveStudioReader(tmp_path, cameras=[1]).read()
    for whole, mine, other in zip(log.sweeps, data.driving_log.sweeps, alone.sweeps, strict=True):
        assert torch.equal(mine.points, whole.points)
        assert torch.equal(mine.colors, other.colors)
        assert torch.equal(mine.colored, other.colored)
    assert [sweep.colored.tolist() for sweep in data.driving_log.sweeps.gray()] == [
        sweep.colored.tolist() for sweep in alone.sweeps
    ]
    assert any(
        not torch.equal(sweep.colors, other.colors) for sweep, other in zip(log.sweeps, alone.sweeps, strict=True)
    )
    assert StreetData(log, stride=2, offset=1, cameras=["0"]).split_in_words == "every 2th frame from 1 and camera 0"


def test_returns_that_only_a_held_out_camera_sees_count_as_unseen(tmp_path):
    """The other camera looks back, where there are other returns."""
    make_nuscenes(tmp_path)
    for path in (tmp_path / "extrinsics").glob("*_1.txt"):
        np.savetxt(path, np.loadtxt(path) @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    log = DriveStudioReader(tmp_path).read()
    sweeps = StreetData(log, stride=0, cameras=["0"]).driving_log.sweeps
    alone = DriveStudioReader(tmp_path, cameras=[1]).read()
    expected = [sweep.colored.tolist() for sweep in alone.sweeps]
    assert [sweep.colored.tolist() for sweep in sweeps] == expected
    assert [sweep.colored.tolist() for sweep in sweeps.gray()] == expected
    assert [sweep.colored.tolist() for sweep in log.sweeps] != expected
