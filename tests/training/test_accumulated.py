"""Steps of several images: what happens once a step does not happen for each image, and statistics are those of one."""

import copy
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning import Callback

from sparsestreet.pruning import OpacityRule
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.training.callbacks import Checkpoints, DensityControl, GracefulStop, MaskTraining, Pruning
from sparsestreet.training.lightning import begins_step, check_images, ends_step, image_number, steps_for
from sparsestreet.training.schedule import Interval
from tests.training.stubs import Listener, StubTrainer, background, frame_at, make_system, set_rows

ALWAYS = Interval(0.0, 1.0, every=1)


def trainer_of(*callbacks: Callback, accumulated: int = 2, ranks: Ranks = ALONE) -> StubTrainer:
    mask = StaticMaskSettings(sparsity_weight=1.0)
    density = GradientDensity(grad_threshold=1e9)
    system = make_system({"road": background(6, mask=mask, density=density)})
    set_rows(system.scene.nodes["road"], "mask_logits", {0: -20.0})
    set_rows(system.scene.nodes["road"], "opacity_logits", {1: -20.0})
    trainer = StubTrainer(system, callbacks, max_steps=20)
    trainer.accumulate_grad_batches, trainer.world_size = accumulated, ranks.size
    trainer.strategy = SimpleNamespace(ranks=ranks, broadcast=lambda value: value)
    trainer.start()
    return trainer


@pytest.mark.parametrize(
    ("callback", "reason"),
    [
        (DensityControl(ALWAYS, 1.0, Interval(0.0, 0.0)), "cull"),
        (MaskTraining(ALWAYS), "mask"),
        (Pruning([0.5], OpacityRule(keep=3)), "pruning"),
    ],
)
def test_rows_change_when_the_optimizer_has_stepped(callback, reason):
    """In between, gradients of the images before would be lost with the rows."""
    heard = Listener()
    trainer = trainer_of(callback, heard)
    trainer.global_step = 10
    callback.on_train_batch_end(trainer, trainer.system, None, None, 6)
    assert heard.heard == []
    callback.on_train_batch_end(trainer, trainer.system, None, None, 7)
    assert reason in [change.reason for change, _ in heard.heard if change.after < change.before]


def test_opacities_are_reset_before_the_first_image_of_a_step():
    heard = Listener()
    control = DensityControl(ALWAYS, 1.0, Interval(0.0, 1.0, every=10))
    trainer = trainer_of(control, heard)
    trainer.global_step = 10
    control.on_train_batch_start(trainer, trainer.system, None, 7)
    assert heard.heard == []
    control.on_train_batch_start(trainer, trainer.system, None, 8)
    assert heard.reasons == [(10, "road", "opacity reset")]


def test_files_are_of_whole_steps(tmp_path: Path):
    """A signal waits for the end of the step, and a checkpoint is written once."""
    stop, checkpoints = GracefulStop(), Checkpoints(tmp_path, every=5)
    trainer = trainer_of()
    trainer.global_step, stop.received = 5, 15
    checkpoints.on_train_batch_end(trainer, trainer.system, None, None, 2)
    stop.on_train_batch_end(trainer, trainer.system, None, None, 2)
    assert not any(tmp_path.iterdir())
    checkpoints.on_train_batch_end(trainer, trainer.system, None, None, 3)
    assert (tmp_path / "last.ckpt").read_text() == "5"
    with pytest.raises(KeyboardInterrupt):
        stop.on_train_batch_end(trainer, trainer.system, None, None, 3)


@pytest.mark.parametrize(("accumulated", "ranks"), [(1, ALONE), (4, ALONE), (2, Ranks(0, 2))])
def test_statistics_are_those_of_an_image_by_itself(accumulated, ranks):
    """Thresholds are for the gradient of one image's loss; that of a step is a mean. Powers of two: to the bit."""
    control = DensityControl(ALWAYS, 1.0, Interval(0.0, 0.0))
    trainer = trainer_of(control, accumulated=accumulated, ranks=ranks)
    trainer.global_step = 1
    system = trainer.system
    system.screen_gradients = True
    loss = system.training_step(frame_at(1), 0)
    (loss / (accumulated * ranks.size)).backward()
    control.on_after_backward(trainer, system)
    gradients = copy.deepcopy(control.statistics["road"].gradient_sum)
    assert gradients.max() > 0

    alone = DensityControl(ALWAYS, 1.0, Interval(0.0, 0.0))
    single = trainer_of(alone, accumulated=1)
    single.global_step, single.system.screen_gradients = 1, True
    single.system.training_step(frame_at(1), 0).backward()
    alone.on_after_backward(single, single.system)
    assert torch.equal(gradients, alone.statistics["road"].gradient_sum)


@pytest.mark.parametrize(("rank", "unseen"), [(0, 1), (1, 0)])
def test_the_first_view_is_that_of_the_first_process(rank, unseen):
    """DriveStudio counts it for rows that it does not show; of two processes both see a first view."""
    control = DensityControl(ALWAYS, 1.0, Interval(0.0, 0.0), first_counts_all=True)
    trainer = trainer_of(control, accumulated=1, ranks=Ranks(rank, 2))
    trainer.global_step, trainer.system.screen_gradients = 1, True
    with torch.no_grad():
        trainer.system.scene.nodes["road"].rows.means[2, 2] = -5.0  # behind the camera
    trainer.system.training_step(frame_at(1), 0).backward()
    control.on_after_backward(trainer, trainer.system)
    assert control.statistics["road"].visits[2] == unseen


def test_images_are_counted_as_one_process_would_see_them():
    numbers = []
    for step in range(2):
        for batch in (2 * step, 2 * step + 1):
            for rank in range(3):
                trainer = trainer_of(accumulated=2, ranks=Ranks(rank, 3))
                trainer.global_step = step
                numbers.append(image_number(trainer, batch))
                assert begins_step(trainer, batch) == (batch % 2 == 0) != ends_step(trainer, batch)
    assert numbers == list(range(12))


def test_a_run_has_as_many_images_in_fewer_steps():
    trainer = trainer_of(accumulated=2, ranks=Ranks(0, 3))
    assert [steps_for(trainer, images) for images in (600, 601, 1)] == [100, 101, 1]
    assert steps_for(trainer_of(accumulated=1), 600) == 600
    check_images(trainer, 6)
    with pytest.raises(ValueError, match="a step takes 6 images, of 3 processes and 2 batches each, but there are 5"):
        check_images(trainer, 5)
