"""From a configuration to the objects of a run, and one run of it in a process that suits it."""

import logging
import shlex
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning import Callback, Trainer
from omegaconf import DictConfig

from sparsestreet.cli.config.compose import check_moved, configuration, resolved, with_images
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.validate import config_problem, preset_notes
from sparsestreet.cli.process import is_worker_rank, keep_freed_memory
from sparsestreet.cli.runs.folder import (
    give_back,
    lies_in,
    moments_to_keep,
    run_of,
    start_from_trunk,
    start_of,
    take_folder,
)
from sparsestreet.cli.runs.locks import devices_of_job
from sparsestreet.cli.runs.tracks import finds, with_tracks, write_tracks
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import counted
from sparsestreet.evaluation.speed import forget_peaks
from sparsestreet.kept import Kept
from sparsestreet.phases import StageRecorder, stage
from sparsestreet.records.configuration import flat_config
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.callbacks import PhaseTimes
from sparsestreet.training.recipe import Recipe, RunIdentity
from sparsestreet.training.run import build, fit, train
from sparsestreet.training.system import StreetSystem


def recipe_of(cfg: DictConfig) -> Recipe:
    """The parts of a training, before any data is read. Raises ValueError where they do not fit together."""
    cfg = cfg.copy()  # instantiate writes values in the place of what follows from the log
    recipe = Recipe(
        nodes=instantiate(cfg.node, _convert_="all"),
        effects=instantiate(cfg.effects, _convert_="all") if cfg.effects else {},
        losses=instantiate(cfg.loss, _convert_="all"),
        callbacks=instantiate(cfg.callback, _convert_="all"),
        optimizer=instantiate(cfg.optimizer, _convert_="all"),
        options=_render_options(cfg),
        sh_interval=cfg.schedule.sh_interval,
        sh_every=cfg.schedule.sh_every,
        sh_every_from=cfg.schedule.sh_every_from,
        resolution=instantiate(cfg.schedule.resolution, _convert_="all"),
        seed=cfg.seed,
        image_points=instantiate(cfg.image_points, _convert_="all") if cfg.image_points else None,
        moved_views=instantiate(cfg.moved_views, _convert_="all") if cfg.moved_views else None,
    )
    recipe.check()
    return recipe


def _render_options(cfg: DictConfig) -> RenderOptions:
    """Without the name of the preset: its values stand in the settings."""
    said = resolved(cfg.render)
    return instantiate({key: value for key, value in said.items() if key != "preset"}, _convert_="all")


def data_of(cfg: DictConfig, run: Path | None = None) -> StreetData:
    """The log, and its split into views to train on and views held out.

    ``run``: one that has begun, and knows what it has found (``tracks.with_tracks``).

    Raises ValueError for a key that has moved.
    """
    check_moved(cfg)
    reader = reader_of(cfg)
    log = reader.read()
    if (identity := reader.identity()) is not None:
        log = replace(log, kept=Kept(cfg.get("cache"), identity))
    log = with_tracks(cfg, log, run)
    # A matter of the log, though it is listed with the effects: its frames are masked before anything sees them.
    return StreetData(log, **cfg.split, seed=cfg.seed, hood=_masked_from(cfg, "hood"), dirt=_masked_from(cfg, "dirt"))


def _masked_from(cfg: DictConfig, name: str) -> float | None:
    """Share of an image from which what an effect finds is masked; None: it is not looked for."""
    effect = cfg.effects.get(name) if cfg.effects else None
    return None if effect is None or effect.when == "off" else effect.min_share


def opened(cfg: DictConfig) -> tuple[DictConfig, StreetData, Recipe]:
    """Read the log; return the configuration that knows what training sees, the log, and the parts of the training."""
    data = data_of(cfg)
    known = with_images(cfg, len(data.split.train))
    return known, data, recipe_of(known)


def trainer_of(cfg: DictConfig, devices: Any) -> Callable[..., Trainer]:
    """What makes Lightning's trainer, on these devices, once its callbacks are there."""
    return instantiate(cfg.trainer, _partial_=True, devices=devices)


_IMAGES = "training_views.images"


def identity_of(cfg: DictConfig, command: str) -> RunIdentity:
    """What the run is called in its records. Reads the log's files for their hash."""
    config, least = (flat_config(resolved(one)) for one in (cfg, with_images(cfg, None)))
    return RunIdentity(
        label=cfg.name,
        method=cfg.method.name,
        sparsify=cfg.sparsify.name,
        config=config,
        follows={key: value for key, value in least.items() if value != config.get(key) and key != _IMAGES},
        data_hash=reader_of(cfg).data_hash(),
        command=command,
    )


def this_command(words: Sequence[str]) -> str:
    """A command as it is typed: the words after ``sparsestreet``."""
    return shlex.join(["sparsestreet", *words])


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
    extra, logger = instantiate(cfg.evaluation, _convert_="all"), instantiate(cfg.logger) if cfg.logger else False
    stages = StageRecorder(started)
    with stages, stage("start"):
        start = start_of(cfg, out) or start_from_trunk(cfg, out)
    with stages, stage("data"):
        data = data_of(cfg, None if start is None else run_of(start))
        log.info("%s", _window_of(cfg, data))
    with stages, stage("start"):
        known = with_images(cfg, len(data.split.train))
        # The job's own overrides: in a sweep they are not what was typed.
        identity = identity_of(known, this_command(["train", *HydraConfig.get().overrides.task]))
        recipe = recipe_of(known)
        if not is_worker_rank(cfg.trainer):
            take_folder(cfg, out, goes_on=start is not None and lies_in(start, out))
            if finds(known, data.driving_log):
                write_tracks(out, data.driving_log.tracks)
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
    if summary is None:
        return 0.0
    give_back(cfg, out, of_sweep=HydraConfig.get().mode == RunMode.MULTIRUN)
    return summary.mean("psnr_full")


def _window_of(cfg: DictConfig, data: StreetData) -> str:
    """Which part of which drive is trained on, in words."""
    street, window = data.driving_log, [cfg.data.log.get(key) for key in ("first_frame", "last_frame")]
    said = "" if None in window else ", from {} to {} of the recording".format(*window)
    return f"log {street.name}: {counted(street.num_frames, 'frame')}{said.replace('to -1', 'to the last')}"


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
        known, data, recipe = opened(cfg)
        system = build(recipe, data, recipe.plan(data))
        # One recorder at a time.
        callbacks = [callback for callback in recipe.callbacks.values() if not isinstance(callback, PhaseTimes)]
        with devices_of_job(known.trainer) as devices:
            make = trainer_of(known, devices)
            fit(system, data, [*callbacks, watch], make, folder, max_steps=known.trainer.max_steps)
        return system

    return train
