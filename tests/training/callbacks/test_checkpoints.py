"""When a checkpoint is written, under which name, and what a failed one leaves."""

import logging
import os
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from sparsestreet.ranks import LostProcessError
from sparsestreet.training.callbacks import Checkpoints, newest_checkpoint
from sparsestreet.training.callbacks.files import TornStop, step_of
from tests.training.stubs import StubTrainer, background, make_system


class HalfWritten(StubTrainer):
    """Its checkpoints fail half way from a step on."""

    fails_from = 100

    def save_checkpoint(self, filepath: Path, weights_only: bool | None = None, storage_options: Any = None) -> None:
        if self.global_step >= self.fails_from:
            filepath.write_text("ha")
            raise OSError("no space left on device")
        super().save_checkpoint(filepath)


def trainer_in(folder: Path, every: int = 2, max_steps: int = 5) -> HalfWritten:
    """Its only callback writes checkpoints, whose content is their step; all is restored."""
    trainer = HalfWritten(make_system({"background": background(1)}), [Checkpoints(folder, every)], max_steps=max_steps)
    trainer.callbacks[0].on_train_start(trainer, trainer.system)
    return trainer


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()} if folder.exists() else {}


def test_a_checkpoint_every_few_steps_and_one_at_the_end(tmp_path):
    trainer = trainer_in(tmp_path / "run" / "checkpoints")
    folder, seen = tmp_path / "run" / "checkpoints", []
    for step in range(1, 6):
        trainer.walk(step)
        seen.append(contents(folder).get("last.ckpt"))
    assert seen == [None, "2", "2", "4", "4"]
    trainer.callbacks[0].on_train_end(trainer, trainer.system)
    assert contents(folder) == {"last.ckpt": "5"}


def test_the_last_step_is_left_to_the_end(tmp_path):
    trainer = trainer_in(tmp_path, every=5)
    trainer.walk(5)
    assert contents(tmp_path) == {}


def test_an_exception_leaves_the_step_that_was_done_and_a_finished_run_takes_it_away(tmp_path, caplog):
    trainer = trainer_in(tmp_path / "run" / "checkpoints")
    folder, callback = tmp_path / "run" / "checkpoints", trainer.callbacks[0]
    trainer.walk(3)
    callback.on_exception(trainer, trainer.system, KeyboardInterrupt())
    assert contents(folder) == {"last.ckpt": "2", "interrupted.ckpt": "3"}
    assert caplog.messages == [f"stopped after step 3; go on with resume={tmp_path / 'run'}"]
    trainer.interrupted = True
    callback.on_train_end(trainer, trainer.system)
    assert contents(folder) == {"last.ckpt": "2", "interrupted.ckpt": "3"}
    trainer.interrupted = False
    trainer.walk(5)
    callback.on_train_end(trainer, trainer.system)
    assert contents(folder) == {"last.ckpt": "5"}


def test_one_before_a_moment_has_the_last_step_before_what_happens_after_it(tmp_path):
    """At 60 % of 10 steps something happens in step 6: the checkpoint is of step 5, and stays."""
    system = make_system({"background": background(1)})
    trainer = HalfWritten(system, [Checkpoints(tmp_path, every=100, before=(0.6,))], max_steps=10)
    trainer.walk(10)
    assert contents(tmp_path) == {"before_0.6.ckpt": "5"}


def test_a_half_written_one_of_a_killed_process_goes(tmp_path):
    for name in (".last.99999.tmp.ckpt", "last.ckpt", "mine.tmp.ckpt"):
        (tmp_path / name).write_text("half")
    trainer = trainer_in(tmp_path)
    trainer.callbacks[0].on_train_start(trainer, trainer.system)
    assert contents(tmp_path) == {"last.ckpt": "half", "mine.tmp.ckpt": "half"}


@pytest.mark.parametrize(("step", "exception"), [(3, TornStop()), (0, RuntimeError("no data"))])
def test_half_a_step_and_no_step_leave_no_checkpoint(tmp_path, step, exception):
    trainer = trainer_in(tmp_path)
    trainer.walk(step)
    trainer.callbacks[0].on_exception(trainer, trainer.system, exception)
    assert "interrupted.ckpt" not in contents(tmp_path)


def test_what_fails_while_a_state_is_restored_leaves_no_checkpoint(tmp_path):
    """Its step was, but not its moments, and the next run would have gone on from that."""
    trainer = HalfWritten(make_system({"background": background(1)}), [Checkpoints(tmp_path)], max_steps=5)
    trainer.global_step = 3
    trainer.callbacks[0].on_exception(trainer, trainer.system, ValueError("another optimizer"))
    assert contents(tmp_path) == {}


def test_what_fails_inside_a_step_leaves_no_checkpoint(tmp_path, caplog):
    """Some parameters may have moved and others not."""
    trainer = trainer_in(tmp_path)
    trainer.walk(3)
    trainer.callbacks[0].on_train_batch_start(trainer, trainer.system, None, 3)
    trainer.callbacks[0].on_exception(trainer, trainer.system, RuntimeError("no memory"))
    assert contents(tmp_path) == {"last.ckpt": "2"}
    assert caplog.messages == ["stopped inside step 4: go on from the checkpoint before it"]


def test_a_flipped_bit_in_a_tensor_is_found(tmp_path):
    """torch reads tensors without a look at their checksums."""
    path = tmp_path / "last.ckpt"
    torch.save({"global_step": 7, "rows": torch.full((4,), 0.5)}, path)
    assert step_of(path) == 7
    with zipfile.ZipFile(path) as archive:
        (name,) = (entry for entry in archive.namelist() if entry.endswith("data/0"))
        values = archive.read(name)
    content = bytearray(path.read_bytes())
    content[content.index(values)] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checksum of .*data/0 is wrong"):
        step_of(path)


def test_a_full_disk_stops_no_training_but_is_an_error_at_the_end(tmp_path, caplog):
    """The checkpoint before stays whole, and nothing half written stays beside it."""
    trainer = trainer_in(tmp_path)
    trainer.walk(2)
    trainer.fails_from = 3
    with caplog.at_level(logging.ERROR):
        trainer.walk(5)
        trainer.callbacks[0].on_exception(trainer, trainer.system, KeyboardInterrupt())
    assert contents(tmp_path) == {"last.ckpt": "2"}
    assert [message[:7] for message in caplog.messages] == ["step 4:", "step 5:"]
    with pytest.raises(OSError, match="no space left"):
        trainer.callbacks[0].on_train_end(trainer, trainer.system)
    assert contents(tmp_path) == {"last.ckpt": "2"}


def test_a_lost_process_is_no_full_disk(tmp_path, monkeypatch):
    trainer = trainer_in(tmp_path)

    def lost(filepath: Path, **options: Any) -> None:
        raise LostProcessError("another process does not answer")

    monkeypatch.setattr(trainer, "save_checkpoint", lost)
    with pytest.raises(LostProcessError):
        trainer.walk(2)


def test_the_newest_checkpoint_is_the_one_that_was_written_last(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    with pytest.raises(FileNotFoundError, match="has no checkpoint to go on from"):
        newest_checkpoint(tmp_path)
    for newest, older in (("last.ckpt", "interrupted.ckpt"), ("interrupted.ckpt", "last.ckpt")):
        for name, seconds in ((older, 1000), (newest, 2000)):
            (folder / name).touch()
            os.utime(folder / name, (seconds, seconds))
        assert newest_checkpoint(tmp_path) == folder / newest
    (folder / "interrupted.ckpt").unlink()
    assert newest_checkpoint(tmp_path) == folder / "last.ckpt"
