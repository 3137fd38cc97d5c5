"""One run: train, evaluate, record."""

import logging
import sys
import warnings
from pathlib import Path

import torch
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from omegaconf import DictConfig

from sparsestreet.cli.assemble import data_of, description_of, recipe_of, this_command
from sparsestreet.cli.checks import config_problem
from sparsestreet.evaluation.history import draw_history
from sparsestreet.evaluation.records import read_run, run_path
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.training.callbacks import (
    Checkpoints,
    Clock,
    GracefulStop,
    RunFiles,
    TrainingProgress,
    newest_checkpoint,
)
from sparsestreet.training.curves import kept_curves

log = logging.getLogger(__name__)


def run(cfg: DictConfig, out: Path) -> float:
    """Train and evaluate into a folder; a full-image PSNR, of held-out views where there are any.

    Raises ValueError for a configuration that cannot be or a log that is broken, OSError for files. Ends the program
    with the status of the signal that ended training.
    """
    problem = config_problem(cfg)
    if problem:
        raise ValueError(problem)
    recipe = recipe_of(cfg)
    checkpoint = _checkpoint(cfg)
    seed_everything(cfg.seed, verbose=False)
    silence_known_noise()
    data = data_of(cfg)
    trainer, stop = build_trainer(cfg, list(recipe.callbacks.values()), out, data)
    system = recipe.build(data)
    # A checkpoint holds the state of callbacks and optimizer as well, so it is no file of weights only.
    resume = {} if checkpoint is None else {"ckpt_path": checkpoint, "weights_only": False}
    at = None if checkpoint is None else torch.load(checkpoint, map_location="cpu", weights_only=False)["global_step"]
    try:
        with kept_curves(out / "curves" / "metrics.csv", at):
            trainer.fit(system, datamodule=data, **resume)
    except SystemExit:
        sys.exit(stop.exit_status or 1)
    if trainer.fast_dev_run:
        log.info("fast_dev_run: stopped after %d steps without evaluation", trainer.global_step)
        return 0.0
    summary = evaluate_scene(
        system.scene,
        data.split.held_out,
        data.split.train,
        run=read_run(run_path(out)),
        options=system.options,
        out=out,
        command=this_command(),
        device=trainer.strategy.root_device,
    )
    draw_history(out)
    log.info("records and pictures in %s", out)
    split = "held_out" if "held_out" in summary.quality else "training"
    return summary.quality[split]["psnr_full"].mean


def build_trainer(cfg: DictConfig, callbacks: list, out: Path, data) -> tuple[Trainer, GracefulStop]:
    """The trainer with the configured callbacks and those that every run has."""
    clock, stop = Clock(), GracefulStop()
    trainer: Trainer = instantiate(
        cfg.trainer,
        callbacks=[clock, *callbacks, TrainingProgress()],
        logger=instantiate(cfg.logger) if cfg.logger else False,
        default_root_dir=str(out),
        enable_model_summary=False,
        enable_progress_bar=False,
        enable_checkpointing=False,
        max_epochs=-1,
    )
    description = description_of(cfg, data.driving_log, trainer.strategy.root_device)
    trainer.callbacks += [RunFiles(out, description, clock), Checkpoints(out / "checkpoints"), stop]
    return trainer, stop


def _checkpoint(cfg: DictConfig) -> Path | None:
    """The checkpoint to go on from, if any."""
    if not cfg.resume:
        return None
    path = Path(cfg.resume)
    return newest_checkpoint(path) if path.is_dir() else path


def silence_known_noise() -> None:
    """Hints of Lightning that do not apply: frames come from a cache, a loader process would copy them."""
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Experiment logs directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
