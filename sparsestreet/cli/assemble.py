"""From a config to the objects of a run."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.utils import instantiate
from lightning import Callback, Trainer
from omegaconf import DictConfig, OmegaConf

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation.speed import device_name
from sparsestreet.records.configuration import config_hash, flat_config
from sparsestreet.records.provenance import this_machine, this_source
from sparsestreet.records.run import RunDescription
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.recipe import Recipe


def recipe_of(cfg: DictConfig) -> Recipe:
    """The parts of a training, before any data is read. Raises ValueError where they do not fit together."""
    recipe = Recipe(
        nodes=instantiate(cfg.node, _convert_="all"),
        sky=instantiate(cfg.sky, _convert_="all") if cfg.sky else None,
        losses=instantiate(cfg.loss, _convert_="all"),
        callbacks=instantiate(cfg.callback, _convert_="all"),
        optimizer=instantiate(cfg.optimizer, _convert_="all"),
        options=_render_options(cfg),
        sh_interval=cfg.schedule.sh_interval,
        seed=cfg.seed,
        image_points=instantiate(cfg.image_points, _convert_="all") if cfg.image_points else None,
    )
    problems = recipe.problems()
    if problems:
        raise ValueError("; ".join(problems))
    return recipe


def _render_options(cfg: DictConfig) -> RenderOptions:
    """Without the name of the preset: its values stand in the settings."""
    said = OmegaConf.to_container(cfg.render, resolve=True)
    return instantiate({key: value for key, value in said.items() if key != "preset"}, _convert_="all")


def data_of(cfg: DictConfig) -> StreetData:
    """The log, and its split into views to train on and views held out."""
    log = instantiate(cfg.data.log, _convert_="all").read()
    return StreetData(log, **cfg.split, seed=cfg.seed)


def trainer_of(cfg: DictConfig, callbacks: Sequence[Callback], out: Path) -> Trainer:
    """Lightning's, with these callbacks and nothing of its own beside them."""
    return instantiate(
        cfg.trainer,
        callbacks=list(callbacks),
        logger=instantiate(cfg.logger) if cfg.logger else False,
        default_root_dir=str(out),
        enable_model_summary=False,
        enable_progress_bar=False,
        enable_checkpointing=False,
        max_epochs=-1,
    )


def description_of(cfg: DictConfig, log: DrivingLog, device: torch.device, command: str) -> RunDescription:
    """What identifies a run that is about to start on a device."""
    config = flat_config(OmegaConf.to_container(cfg, resolve=True))
    return RunDescription(
        method=cfg.method.name,
        sparsify=cfg.sparsify.name,
        label=cfg.name,
        scene=log.name,
        seed=cfg.seed,
        split=split_in_words(cfg),
        config=config,
        config_hash=config_hash(config),
        data_hash=instantiate(cfg.data.log, _convert_="all").data_hash(),
        command=command,
        device=device_name(device),
        threads=torch.get_num_threads(),
        steps=0,
        max_steps=cfg.schedule.max_steps,
        training_seconds=None,
        noise=None,
        caps={},
        machine=this_machine(),
        source=this_source(),
    )


def split_in_words(cfg: DictConfig) -> str:
    """Which frames are held out."""
    return f"every {cfg.split.stride}th frame from {cfg.split.offset}" if cfg.split.stride else "none"


def this_command(words: Sequence[str]) -> str:
    """A command as it is typed: the words after ``sparsestreet``."""
    return shlex.join(["sparsestreet", *words])
