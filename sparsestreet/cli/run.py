"""One run: train, evaluate, record."""

import logging
import sys
import warnings
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Callback, Trainer, seed_everything
from omegaconf import DictConfig

from sparsestreet.cli.assemble import data_of, description_of, recipe_of, this_command, trainer_of
from sparsestreet.cli.checks import config_problem
from sparsestreet.cli.process import keep_freed_memory
from sparsestreet.data.datamodule import StreetData
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.memory import forget_peaks, peak_megabytes
from sparsestreet.evaluation.run import evaluate_scene
from sparsestreet.phases import StageRecorder, stage
from sparsestreet.pictures.history import draw_history
from sparsestreet.records.costs import stage_costs, step_costs, update_costs
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import RunSummary
from sparsestreet.training.callbacks import (
    Checkpoints,
    Clock,
    GracefulStop,
    HeldOutCurve,
    RunFiles,
    StageTimes,
    TrainingProgress,
    newest_checkpoint,
)
from sparsestreet.training.curves import kept_curves
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)


def run(cfg: DictConfig, out: Path, started: float) -> float:
    """Train and evaluate into a folder; a full-image PSNR, of held-out views where there are any.

    ``started`` is ``time.perf_counter`` when the command began.

    Raises ValueError for a configuration that cannot be or a log that is broken, OSError for files. Ends the program
    with the status of the signal that ended training.
    """
    # A sweep's launcher starts processes of its own.
    keep_freed_memory()
    forget_peaks()
    problem = config_problem(cfg)
    if problem:
        raise ValueError(problem)
    recipe, looks = recipe_of(cfg), instantiate(cfg.evaluation, _convert_="all")
    seed_everything(cfg.seed, verbose=False)
    silence_known_noise()
    # The job's own overrides: in a sweep they are not what was typed.
    command = this_command(["train", *HydraConfig.get().overrides.task])
    with StageRecorder(started) as recorder:
        summary, device = _train_and_evaluate(cfg, recipe, looks, recorder, out, command)
        if summary is None:
            return 0.0
        with stage("pictures"):
            draw_history(out)
        _write_costs(out, recorder, device)
    log.info("records and pictures in %s", out)
    return summary.quality[summary.main_split]["psnr_full"].mean


def _train_and_evaluate(
    cfg: DictConfig, recipe: Recipe, looks: ExtraMetrics, recorder: StageRecorder, out: Path, command: str
) -> tuple[RunSummary | None, torch.device]:
    """What was measured (None of a ``fast_dev_run``), and the device."""
    with stage("data"):
        data = data_of(cfg)
    for note in data.driving_log.notes:
        log.info(note)
    with stage("initialize"):
        system = recipe.build(data)
    callbacks = [*recipe.callbacks.values(), StageTimes(recorder)]
    with stage("train"):
        trainer = _train(cfg, callbacks, system, data, out, command)
    device = trainer.strategy.root_device
    if trainer.fast_dev_run:
        log.info("fast_dev_run: stopped after %d steps without evaluation", trainer.global_step)
        return None, device
    with stage("evaluate"):
        summary = evaluate_scene(
            system.scene,
            data.split.held_out,
            data.split.train,
            run=RUN.read(out),
            options=system.options,
            out=out,
            command=command,
            device=device,
        )
    looks.take(system.scene, data, system.options, out=out, command=command, say=log.info)
    return summary, device


def _write_costs(out: Path, recorder: StageRecorder, device: torch.device) -> None:
    """What the command cost; the last that it writes, so that a run with costs is a whole one."""
    host, on_device = peak_megabytes(device)
    seconds = recorder.seconds()
    phases, passes = stage_costs(seconds)
    update_costs(
        out,
        wall_seconds=sum(seconds.values()),
        phases=phases,
        passes=passes,
        step_ms=step_costs(out),
        peak_host_mb=host,
        peak_device_mb=on_device,
    )


def _train(
    cfg: DictConfig, callbacks: list[Callback], system: StreetSystem, data: StreetData, out: Path, command: str
) -> Trainer:
    """Fit to the end, or end the program as the signal wants that came."""
    clock, stop, checkpoint = Clock(), GracefulStop(), _checkpoint(cfg)
    curve = HeldOutCurve(out, clock)
    trainer = trainer_of(cfg, [clock, *callbacks, curve, TrainingProgress()], out)
    with stage("data"):  # its files are read for a hash
        description = description_of(cfg, data.driving_log, trainer.strategy.root_device, command)
    trainer.callbacks += [RunFiles(out, description, clock), Checkpoints(out / "checkpoints"), stop]
    # A checkpoint holds the state of callbacks and optimizer as well, so it is no file of weights only.
    resume = {} if checkpoint is None else {"ckpt_path": checkpoint, "weights_only": False}
    at = None if checkpoint is None else torch.load(checkpoint, map_location="cpu", weights_only=False)["global_step"]
    try:
        with kept_curves(out, at):
            trainer.fit(system, datamodule=data, **resume)
    except SystemExit:
        sys.exit(stop.exit_status or 1)
    return trainer


def _checkpoint(cfg: DictConfig) -> Path | None:
    """The checkpoint to go on from, if any."""
    if not cfg.resume:
        return None
    path = Path(cfg.resume)
    return newest_checkpoint(path) if path.is_dir() else path


def silence_known_noise() -> None:
    """Hints of Lightning that do not apply.

    Frames lie in a cache that worker processes would copy; a run that holds nothing out has nothing to validate on.
    """
    warnings.filterwarnings("ignore", message="Total length of .list. across ranks is zero.*")
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Experiment logs directory .* exists and is not empty.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
