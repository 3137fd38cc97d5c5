"""Configurations of a training, each composed once: that takes a quarter of a second."""

from functools import cache

from hydra import compose
from omegaconf import DictConfig

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
