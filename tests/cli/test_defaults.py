"""What a training from Python starts from unless it is told otherwise is what conf/ says."""

import pytest
from hydra import compose
from lightning import Trainer

from sparsestreet.cli.assemble import recipe_of, trainer_of
from sparsestreet.cli.compose import configuration
from sparsestreet.scene.nodes import BackgroundSettings, RigidSettings
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.run import CPU_TRAINER
from tests.typed import as_a


@pytest.fixture(scope="module")
def cfg():
    with configuration():
        return compose("train", ["folder=.", "schedule=paper", "sparsify=masks"])


def test_the_trainer(cfg):
    configured = trainer_of(cfg)
    assert configured.func is CPU_TRAINER.func is Trainer
    # What is left out has these values by itself.
    plain = {"max_steps": cfg.schedule.max_steps, "precision": "32-true", "fast_dev_run": False}
    assert configured.keywords == CPU_TRAINER.keywords | plain


def test_learning_rates_and_sources(cfg):
    nodes = recipe_of(cfg).nodes
    assert RigidSettings().learning_rates == nodes["rigid"].learning_rates
    usual, configured = BackgroundSettings(), as_a(BackgroundSettings, nodes["background"])
    assert usual.learning_rates.items() >= configured.learning_rates.items()
    assert usual.sources == configured.sources
    assert usual.num_points == configured.num_points
    assert (usual.prunable, usual.masked) == (configured.prunable, configured.masked)


def test_the_rest_of_a_recipe(cfg):
    usual, configured = Recipe(nodes={}), recipe_of(cfg)
    assert usual.optimizer == configured.optimizer
    assert usual.options == configured.options
    assert usual.losses["photometric"] == configured.losses["photometric"]
    assert usual.sh_interval == pytest.approx(configured.sh_interval, rel=2e-3)  # a thirtieth, in four digits there
