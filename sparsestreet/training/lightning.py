"""What Lightning's trainer holds and does not declare."""

from lightning import Callback, Trainer

from sparsestreet.data.datamodule import StreetData


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


def is_dev_run(trainer: Trainer) -> bool:
    """Whether it only tries a few steps (``fast_dev_run``)."""
    return bool(trainer.fast_dev_run)  # pyright: ignore[reportAttributeAccessIssue]


def end_after(trainer: Trainer, steps: int) -> None:
    """Let a training that runs end after another number of steps."""
    trainer.fit_loop.epoch_loop.max_steps = steps
