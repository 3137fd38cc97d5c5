"""What Lightning's trainer holds and does not declare."""

from typing import Any

from lightning import Callback, Trainer

from sparsestreet.data.datamodule import StreetData
from sparsestreet.ranks import ALONE, Ranks


def data_of(trainer: Trainer) -> StreetData:
    """The data module that it trains on."""
    return trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]


def callbacks_of(trainer: Trainer) -> list[Callback]:
    """The callbacks, in their order."""
    return trainer.callbacks  # pyright: ignore[reportAttributeAccessIssue]


def validates_now(trainer: Trainer) -> bool:
    """Whether validation follows the step that is ending; Lightning makes up for none when a run goes on."""
    fetcher = trainer.fit_loop._data_fetcher
    return fetcher is not None and trainer.fit_loop.epoch_loop._should_check_val_fx(fetcher)


def logs_now(trainer: Trainer) -> bool:
    """Whether Lightning's loggers will take what this step says."""
    return trainer._logger_connector.should_update_logs


def logged_number(trainer: Trainer) -> int:
    """Under which its loggers file what a step says: where a run goes on, its count of batches is not the step."""
    return trainer.fit_loop.epoch_loop._batches_that_stepped


def log_numbers(trainer: Trainer, numbers: dict[str, Any], step: int) -> None:
    """Give its loggers numbers of a step that is over."""
    trainer._logger_connector.log_metrics(numbers, step=step)


def is_dev_run(trainer: Trainer) -> bool:
    """Whether it only tries a few steps (``fast_dev_run``)."""
    return bool(trainer.fast_dev_run)  # pyright: ignore[reportAttributeAccessIssue]


def ranks_of(trainer: Trainer) -> Ranks:
    """The processes that train together; one that trains alone is by itself."""
    return getattr(trainer.strategy, "ranks", ALONE)


def images_per_step(trainer: Trainer) -> int:
    """Images whose mean gradient a step takes: of all processes, and of ``accumulate_grad_batches`` batches."""
    return trainer.world_size * trainer.accumulate_grad_batches


def image_number(trainer: Trainer, batch_idx: int) -> int:
    """Number of training images before this one, in the order in which one process would see them."""
    accumulated, ranks = trainer.accumulate_grad_batches, ranks_of(trainer)
    return (trainer.global_step * accumulated + batch_idx % accumulated) * ranks.size + ranks.rank


def begins_step(trainer: Trainer, batch_idx: int) -> bool:
    """Whether a batch is the first whose gradient a step takes; else its rows must stay what they are."""
    return batch_idx % trainer.accumulate_grad_batches == 0


def ends_step(trainer: Trainer, batch_idx: int) -> bool:
    """Whether the optimizer has stepped with a batch."""
    return begins_step(trainer, batch_idx + 1)


def check_images(trainer: Trainer, images: int) -> None:
    """Raise ValueError where a step would take more images than there are to train on."""
    if images_per_step(trainer) > max(images, 1):
        raise ValueError(
            f"a step takes {images_per_step(trainer)} images, of {trainer.world_size} processes and "
            f"{trainer.accumulate_grad_batches} batches each, but there are {images} to train on: use fewer processes"
        )


def steps_for(trainer: Trainer, images: int) -> int:
    """Step in which a trainer sees so many images."""
    return -(-images // images_per_step(trainer))


def end_after(trainer: Trainer, steps: int) -> None:
    """Let a training that runs end after another number of steps."""
    trainer.fit_loop.epoch_loop.max_steps = steps
