"""A training from its first line to its last: build, resume, fit, evaluate, record. Read this page first.

``sparsestreet train`` calls ``train`` with what a configuration says, Python with objects of its own (README).
Callbacks (``training/callbacks``) decide when the scene's rows change and when files are written; the system
(``training/system.py``) is one step.
"""

import logging
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.loggers import CSVLogger, Logger

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.hood import check_used
from sparsestreet.data.log_warnings import log_warnings
from sparsestreet.evaluation.extra import ExtraMetrics
from sparsestreet.evaluation.run import evaluate_scene, help_to_evaluate
from sparsestreet.evidence.light import light_warnings, measured_light
from sparsestreet.phases import StageRecorder, stage
from sparsestreet.pictures.plots import draw_history
from sparsestreet.pictures.sheets import draw_effects
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.file import check_links
from sparsestreet.records.run import RUN
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.result import result_lines
from sparsestreet.scene.effects import EffectPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.callbacks import (
    Checkpoints,
    Clock,
    GracefulStop,
    HeldOutCurve,
    Pace,
    RunFiles,
    StageTimes,
    TrainingProgress,
    newest_checkpoint,
    step_of,
)
from sparsestreet.training.forecast import kept_curves, record_costs
from sparsestreet.training.lightning import check_images, end_after, images_per_step, is_dev_run, ranks_of, steps_for
from sparsestreet.training.recipe import Recipe, RunIdentity
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

CPU_TRAINER = partial(
    Trainer,
    accelerator="cpu",
    devices=1,
    # Between two validations lie steps, not epochs: an epoch is as long as the log.
    check_val_every_n_epoch=None,
    val_check_interval=500,
    log_every_n_steps=10,
)
"""Lightning's Trainer with the settings of conf/trainer/cpu.yaml."""


def train(
    recipe: Recipe,
    data: StreetData,
    out: Path,
    *,
    max_steps: int = 2000,
    minutes: float | None = None,
    make_trainer: Callable[..., Trainer] = CPU_TRAINER,
    logger: Logger | bool | None = None,
    identity: RunIdentity | None = None,
    extra: ExtraMetrics | None = None,
    resume: Path | None = None,
    checkpoint_every: int = 1000,
    checkpoints_before: Sequence[float] = (),
    stages: StageRecorder | None = None,
) -> RunSummary | None:
    """Train a scene and evaluate it; what a run leaves lies in ``out`` (docs/architecture.md lists it).

    Of several processes (``training/parallel``) each one trains and measures its share of the images; the first alone
    writes, times frames and returns a summary.

    Args:
        recipe: the parts of the training. Its callbacks keep state: take a new recipe for another run.
        data: the log, split into views to train on and views held out.
        out: the run's folder.
        max_steps: optimizer steps of one image; with n images a step (of several processes, or accumulated) the run
            has as many images, and an n-th of the steps.
        minutes: of the whole command, from the beginning of ``stages`` on: the steps become as many as fit; None: they
            stay ``max_steps``.
        make_trainer: Lightning's Trainer, or what makes one; ``fit`` shows what it is given.
        logger: of Lightning, for the curves of the training; None: ``curves/metrics.csv``; False: none.
        identity: what the run is called in its records; None: as its folder.
        extra: what is measured beside the record of every run; None: nothing.
        resume: a run's folder, or one of its checkpoints, to go on from; of another run its curves are taken too.
        checkpoint_every: steps between two checkpoints, besides the one at the end.
        checkpoints_before: fractions of the run; ``before_0.6.ckpt`` stays as it is before what happens at 60 %.
        stages: counts the seconds of the command that trains; None: they begin here.

    Returns:
        What was measured of the finished scene; None of a trainer with ``fast_dev_run``, and on all processes but one.

    Raises:
        ValueError: for parts that do not fit together.
        FileNotFoundError: where there is nothing to resume.
        OSError: for files that cannot be written.
        SystemExit: with the status of the signal that ended training, after a checkpoint was written.
    """
    check_links(out)
    identity, extra = identity or RunIdentity(label=out.name), extra or ExtraMetrics()
    checkpoint = resume if resume is None or resume.is_file() else newest_checkpoint(resume)
    with stages or StageRecorder() as stages:
        recipe.check()
        with stage("effects"):
            plan = recipe.plan(data)
        system = build(recipe, data, plan)
        effects = recipe.decisions(plan, data)

        clock, stop = Clock(), GracefulStop()
        callbacks = [
            clock,
            *recipe.callbacks.values(),
            StageTimes(stages),
            Pace(stages, minutes, extra.timing),
            HeldOutCurve(out, clock),
            TrainingProgress(),
            RunFiles(out, identity.describe(recipe, data, max_steps, effects), clock),
            Checkpoints(out / "checkpoints", checkpoint_every, checkpoints_before),
            stop,  # the last: a signal ends training when the others are done with the step
        ]
        logger = CSVLogger(out, name="", version="curves") if logger is None else logger
        try:
            with stage("train"):
                trainer = fit(
                    system, data, callbacks, make_trainer, out, max_steps=max_steps, logger=logger, start=checkpoint
                )
        except SystemExit:
            stop.hand_on()
            sys.exit(stop.exit_status or 1)
        if is_dev_run(trainer):
            log.info("fast_dev_run: stopped after %d steps without evaluation", trainer.global_step)
            return None
        device, ranks = trainer.strategy.root_device, ranks_of(trainer)
        if not trainer.is_global_zero:
            help_to_evaluate(
                system.scene,
                data.split.held_out,
                data.split.train,
                options=system.options,
                out=out,
                device=device,
                ranks=ranks,
                training_lpips=extra.training_lpips,
            )
            return None
        summary = evaluate(
            system.scene, system.options, data, out, device=device, command=identity.command, extra=extra, ranks=ranks
        )
        record_costs(out, stages, device)  # the last file: a run with costs is a whole one
    for line in (*result_lines(summary, out), *recipe.left_whole(summary.gaussians)):
        log.info(line)
    return summary


def build(recipe: Recipe, data: StreetData, plan: EffectPlan) -> StreetSystem:
    """The scene as it starts, from what training may see and through the effects of ``recipe.plan``, ready for ``fit``.

    Raises ValueError for parts of the recipe that do not fit together, that have nothing to start from, and for masks
    that leave no pixel to be used.
    """
    recipe.check()
    seed_everything(recipe.seed, verbose=False)
    for note in data.driving_log.notes:
        log.info(note)
    with stage("initialize"):
        train, street = data.split.train, data.driving_log
        check_used(train, street.name)
        doubts = street.kept.get("doubts", (), lambda: tuple(log_warnings(street, train)))
        for doubt in (*doubts, *light_warnings(measured_light(train, street.kept))):
            log.warning(doubt)
        system = recipe.build(data, plan)
    if street.kept:
        log.info("%s", street.kept)
    return system


def fit(
    system: StreetSystem,
    data: StreetData,
    callbacks: Sequence[Callback],
    make_trainer: Callable[..., Trainer],
    out: Path,
    *,
    max_steps: int,
    logger: Logger | bool = False,
    start: Path | None = None,
) -> Trainer:
    """Train to the end, from the checkpoint ``start`` on if there is one; returns the trainer.

    Lightning's Trainer is made with these callbacks, in their order, and nothing of its own beside them.

    Raises SystemExit where a signal ended training.
    """
    trainer = make_trainer(
        max_steps=max_steps,
        max_epochs=-1,
        callbacks=list(callbacks),
        logger=logger,
        default_root_dir=str(out),
        enable_model_summary=False,
        enable_progress_bar=False,
        enable_checkpointing=False,
    )
    if images_per_step(trainer) > 1 and not is_dev_run(trainer):
        check_images(trainer, len(data.split.train))
        max_steps = steps_for(trainer, max_steps)
        end_after(trainer, max_steps)
    if start is None:
        trainer.fit(system, datamodule=data)
        return trainer
    step = step_of(start)
    if step >= max_steps:
        log.info("%s was finished: all %d steps are done, it is measured again", out, step)
    with kept_curves(out, step if trainer.is_global_zero else None, of=start.parents[1]):
        trainer.fit(system, datamodule=data, ckpt_path=start, weights_only=True)
    return trainer


def evaluate(
    scene: SceneGraph,
    options: RenderOptions,
    data: StreetData,
    out: Path,
    *,
    device: torch.device,
    command: str,
    extra: ExtraMetrics,
    say: Callable[[str], None] = log.info,
    ranks: Ranks = ALONE,
) -> RunSummary:
    """Measure a scene on the views of its log, as ``out/run.json`` identifies it; write records and pictures there.

    ``ranks``: as in ``evaluate_scene``.

    Raises ValueError for renders that are not finite, OSError for a link that leads out of ``out``.
    """
    check_links(out)
    with stage("evaluate"):
        summary = evaluate_scene(
            scene,
            data.split.held_out,
            data.split.train,
            run=RUN.read(out),
            options=options,
            out=out,
            command=command,
            device=device,
            timing=extra.timing,
            training_lpips=extra.training_lpips,
            log=data.driving_log,
            ranks=ranks,
        )
    extra.measure(scene, data, options, out=out, command=command, say=say)
    with stage("pictures"):
        draw_history(out)
        draw_effects(out)
    return summary
