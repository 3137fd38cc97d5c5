"""One run of a configuration: ``training/run.py`` on what it says, in a process that suits it."""

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Callback
from omegaconf import DictConfig

from sparsestreet.cli.config.assemble import (
    data_of,
    identity_of,
    logger_of,
    recipe_of,
    this_command,
    trainer_of,
    with_views,
)
from sparsestreet.cli.config.compose import configuration
from sparsestreet.cli.config.validate import config_problem, preset_notes
from sparsestreet.cli.process import is_worker_rank, keep_freed_memory
from sparsestreet.cli.runs.devices import devices_of_job
from sparsestreet.cli.runs.folder import lies_in, start_of, take_folder
from sparsestreet.cli.runs.shared_prefix import moments_to_keep, start_from_trunk
from sparsestreet.evaluation.speed import forget_peaks
from sparsestreet.phases import StageRecorder, stage
from sparsestreet.training.callbacks import PhaseTimes
from sparsestreet.training.run import build, fit, train
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)


def run(cfg: DictConfig, out: Path, started: float) -> float | None:
    """Train and evaluate into a folder; a full-image PSNR, of held-out views where there are any.

    ``started`` is ``time.perf_counter`` when the command began.

    Raises ValueError for a configuration that cannot be or a log that is broken, OSError for files. Ends the program
    with the status of the signal that ended training.
    """
    # A sweep's launcher starts processes of its own.
    keep_freed_memory()
    forget_peaks()
    silence_known_noise()
    problem = config_problem(cfg)
    if problem:
        raise ValueError(problem)
    for note in preset_notes(cfg):
        log.info(note)
    recipe_of(cfg)  # what does not fit together is said before a log is read
    extra, logger = instantiate(cfg.evaluation, _convert_="all"), logger_of(cfg)
    stages = StageRecorder(started)
    with stages, stage("data"):
        data = data_of(cfg)
    with stages, stage("start"):
        known = with_views(cfg, data)
        # The job's own overrides: in a sweep they are not what was typed.
        identity = identity_of(known, this_command(["train", *HydraConfig.get().overrides.task]))
        recipe = recipe_of(known)
        start = start_of(cfg, out) or start_from_trunk(cfg, out)
        if not is_worker_rank(cfg.trainer):
            take_folder(cfg, out, goes_on=start is not None and lies_in(start, out))
    with devices_of_job(cfg.trainer) as devices:
        summary = train(
            recipe,
            data,
            out,
            max_steps=known.trainer.max_steps,
            minutes=cfg.budget.minutes,
            make_trainer=trainer_of(known, devices),
            logger=logger,
            identity=identity,
            extra=extra,
            resume=start,
            checkpoint_every=cfg.checkpoint_every,
            checkpoints_before=moments_to_keep(cfg),
            stages=stages,
        )
    return 0.0 if summary is None else summary.mean("psnr_full")


def silence_known_noise() -> None:
    """Hints of Lightning that do not apply.

    Frames lie in a cache that worker processes would copy; a run that holds nothing out has nothing to validate on.
    """
    warnings.filterwarnings("ignore", message="Total length of .list. across ranks is zero.*")
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Experiment logs directory .* exists and is not empty.*")
    # Of several processes all log the means over the images of all (``StreetSystem.on_validation_epoch_end``).
    warnings.filterwarnings("ignore", message=".*sync_dist=True.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)


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
