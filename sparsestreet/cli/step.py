"""The training whose steps ``sparsestreet bench step`` looks at."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hydra import compose
from lightning import Callback

from sparsestreet.cli.assemble import data_of, recipe_of, trainer_of, with_views
from sparsestreet.cli.checks import config_problem
from sparsestreet.cli.compose import configuration
from sparsestreet.cli.device import devices_of_job
from sparsestreet.cli.run import silence_known_noise
from sparsestreet.training.callbacks import PhaseTimes
from sparsestreet.training.run import build, fit
from sparsestreet.training.system import StreetSystem

NEVER = 10**9
"""Steps: longer than any run."""


def train_with(overrides: Sequence[str], folder: Path) -> Callable[[Callback], StreetSystem]:
    """Training as these options of ``train`` say, with one more callback, without validation, curves or a run's files.

    What it writes all the same goes into ``folder``. Raises ValueError for options that cannot be.
    """
    quiet = [f"folder={folder}", "logger=none", f"trainer.val_check_interval={NEVER}"]
    with configuration():
        cfg = compose("train", [*overrides, *quiet])
    problem = config_problem(cfg)
    if problem:
        raise ValueError(problem)

    def train(watch: Callback) -> StreetSystem:
        silence_known_noise()
        data = data_of(cfg)
        known = with_views(cfg, data)
        recipe = recipe_of(known)
        system = build(recipe, data, recipe.plan(data))
        # One recorder at a time.
        callbacks = [callback for callback in recipe.callbacks.values() if not isinstance(callback, PhaseTimes)]
        with devices_of_job(known.trainer) as devices:
            make = trainer_of(known, devices)
            fit(system, data, [*callbacks, watch], make, folder, max_steps=known.trainer.max_steps)
        return system

    return train
