"""From a config to the objects of a run."""

import shlex
from collections.abc import Callable, Sequence
from typing import Any

from hydra.utils import instantiate
from lightning import Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig

from sparsestreet.cli.config.compose import check_moved, resolved
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.data.datamodule import StreetData
from sparsestreet.records.configuration import flat_config
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training.identity import RunIdentity
from sparsestreet.training.recipe import Recipe


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


def data_of(cfg: DictConfig) -> StreetData:
    """The log, and its split into views to train on and views held out. Raises ValueError for a key that has moved."""
    check_moved(cfg)
    log = reader_of(cfg).read()
    # A matter of the log, though it is listed with the effects: its frames are masked before anything sees them.
    return StreetData(log, **cfg.split, seed=cfg.seed, hood=_masked_from(cfg, "hood"), dirt=_masked_from(cfg, "dirt"))


def _masked_from(cfg: DictConfig, name: str) -> float | None:
    """Share of an image from which what an effect finds is masked; None: it is not looked for."""
    effect = cfg.effects.get(name) if cfg.effects else None
    return None if effect is None or effect.when == "off" else effect.min_share


def with_views(cfg: DictConfig, data: StreetData) -> DictConfig:
    """The configuration of a run that knows what training sees: its length follows from that."""
    return with_images(cfg, len(data.split.train))


def with_images(cfg: DictConfig, images: int | None) -> DictConfig:
    """The configuration of a run whose training sees so many images."""
    known = cfg.copy()
    known.training_views.images = images
    return known


def trainer_of(cfg: DictConfig, devices: Any) -> Callable[..., Trainer]:
    """What makes Lightning's trainer, on these devices, once its callbacks are there."""
    return instantiate(cfg.trainer, _partial_=True, devices=devices)


def logger_of(cfg: DictConfig) -> Logger | bool:
    """Where curves go; False: nowhere."""
    return instantiate(cfg.logger) if cfg.logger else False


def identity_of(cfg: DictConfig, command: str) -> RunIdentity:
    """What the run is called in its records. Reads the log's files for their hash."""
    return RunIdentity(
        label=cfg.name,
        method=cfg.method.name,
        sparsify=cfg.sparsify.name,
        config=flat_config(resolved(cfg)),
        data_hash=reader_of(cfg).data_hash(),
        command=command,
    )


def this_command(words: Sequence[str]) -> str:
    """A command as it is typed: the words after ``sparsestreet``."""
    return shlex.join(["sparsestreet", *words])
