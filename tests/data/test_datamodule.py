"""Order, repeatability and the trip to the device."""

import dataclasses
import itertools

import lightning
import pytest
import torch

from sparsestreet.data.datamodule import ShuffledFrames, StreetData
from sparsestreet.data.device import to_device
from sparsestreet.types import Frame
from tests.data.streets import make_log


def keys(frames) -> list[tuple[int, int]]:
    return [(frame.frame_index, frame.camera_index) for frame in frames]


def test_an_epoch_is_every_training_frame_once_in_a_new_order():
    data = StreetData(make_log(), stride=4, offset=1, seed=3)
    loader = data.train_dataloader()
    first, second = keys(loader), keys(loader)
    assert len(loader) == len(first) == 18
    assert sorted(first) == sorted(second) == keys(data.split.train)
    assert first != second != keys(data.split.train)


def test_the_order_is_given_by_the_seed():
    log = make_log()
    orders = [keys(StreetData(log, seed=seed).train_dataloader()) for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]
    second_of_zero = StreetData(log, seed=0).train_dataloader()
    list(second_of_zero)
    assert keys(second_of_zero) != orders[2]  # the second epoch of one seed is not the first of the next


def test_the_global_generator_is_neither_read_nor_moved():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    order = keys(StreetData(make_log()).train_dataloader())
    assert torch.equal(torch.rand(3), expected)
    assert order == keys(StreetData(make_log()).train_dataloader())


def test_held_out_frames_come_in_order_every_time():
    loader = StreetData(make_log(), stride=4, offset=1).val_dataloader()
    assert keys(loader) == keys(loader) == [(index, camera) for index in (1, 5, 9) for camera in range(2)]
    assert len(loader) == 6


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


def test_moving_keeps_values_and_types():
    frame = make_log(1).frames[0]
    copy = to_device(frame, torch.device("cpu"))
    for field in dataclasses.fields(frame):
        value = getattr(frame, field.name)
        same = torch.equal(getattr(copy, field.name), value) if torch.is_tensor(value) else True
        assert same
    assert copy.image.dtype == torch.uint8


class Recorder(lightning.LightningModule):
    """Learns nothing; remembers the frames it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[tuple[int, int]] = []
        self.validated: list[tuple[int, int]] = []

    def training_step(self, batch: Frame, batch_index: int) -> torch.Tensor:
        self.seen += keys([batch])
        return self.weight * batch.image.float().mean()

    def validation_step(self, batch: Frame, batch_index: int) -> None:
        self.validated += keys([batch])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(data: StreetData, folder, steps: int, checkpoint: str | None = None) -> Recorder:
    model = Recorder()
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(model, data, ckpt_path=checkpoint)
    trainer.save_checkpoint(folder / "last.ckpt")
    return model


# Lightning 2.6 asks torch about tree leaves in a way that torch 2.13 has deprecated.
@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")
def test_lightning_resumes_in_the_middle_of_an_epoch_with_the_frames_that_were_left(tmp_path):
    log = make_log(6, 1)
    whole = fit(StreetData(log, stride=6, offset=2), tmp_path, steps=12)
    assert len(whole.seen) == 12
    assert set(whole.validated) == {(2, 0)}
    first = fit(StreetData(log, stride=6, offset=2), tmp_path, steps=7)
    second = fit(StreetData(log, stride=6, offset=2), tmp_path, steps=12, checkpoint=str(tmp_path / "last.ckpt"))
    assert first.seen + second.seen == whole.seen
