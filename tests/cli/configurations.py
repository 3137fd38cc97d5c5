"""Configurations of a training, each composed once: that takes a quarter of a second."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.config import compose as of_train
from sparsestreet.cli.config.compose import configuration


def composed(*overrides: str) -> DictConfig:
    """As ``sparsestreet train`` composes them, for all who ask: read it, never change it."""
    return of_train.composed(overrides)


@cache
def composed_with_hydra(*overrides: str, folder: str) -> DictConfig:
    """With what only a running app knows; not to be changed either."""
    with configuration():
        return compose("train", [f"folder={folder}", *overrides], return_hydra_config=True)


def left_run(folder: Path, *words: str, config: Mapping[str, Any]) -> Path:
    """A run with a checkpoint, of these words and this configuration."""
    for name in (".hydra", "checkpoints"):
        (folder / name).mkdir(parents=True)
    (folder / "checkpoints" / "last.ckpt").touch()
    OmegaConf.save(list(words), folder / ".hydra" / "overrides.yaml")
    OmegaConf.save(OmegaConf.create(dict(config)), folder / ".hydra" / "config.yaml")
    return folder
