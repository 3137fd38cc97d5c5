"""What a training from Python starts from unless it is told otherwise is what conf/ says."""

import inspect
from typing import Any

import pytest
from hydra import compose
from hydra.utils import get_object
from lightning import Trainer
from omegaconf import OmegaConf

from sparsestreet.cli.assemble import recipe_of, trainer_of
from sparsestreet.cli.compose import configuration
from sparsestreet.scene.nodes import BackgroundSettings, RigidSettings
from sparsestreet.training.moved_views import MovedViews
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.run import CPU_TRAINER
from tests.typed import as_a


@pytest.fixture(scope="module")
def cfg():
    with configuration():
        return compose("train", ["folder=.", "schedule=paper", "sparsify=masks"])


def test_the_trainer(cfg):
    configured = trainer_of(cfg, cfg.trainer.devices)
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


def test_moved_views(cfg):
    assert recipe_of(cfg).moved_views == MovedViews()


def test_the_rest_of_a_recipe(cfg):
    usual, configured = Recipe(nodes={}), recipe_of(cfg)
    assert usual.optimizer == configured.optimizer
    assert usual.options == configured.options
    assert usual.losses["photometric"] == configured.losses["photometric"]
    assert usual.sh_interval == pytest.approx(configured.sh_interval, rel=2e-3)  # a thirtieth, in four digits there


def values(tree: Any, found: dict[str, tuple[Any, list]]) -> None:
    """By the option of a class or function of ours: its value by itself, and those that a configuration gives."""
    if isinstance(tree, dict):
        target = tree.get("_target_", "")
        if target.startswith("sparsestreet."):
            for name, parameter in inspect.signature(get_object(target)).parameters.items():
                plain = name in tree and isinstance(tree[name], bool | int | float | str | None)
                if plain and parameter.default is not parameter.empty:
                    option = f"{target.rpartition('.')[2]}.{name}"
                    found.setdefault(option, (parameter.default, []))[1].append(tree[name])
        tree = list(tree.values())
    if isinstance(tree, list):
        for branch in tree:
            values(branch, found)


def alike(usual: Any, given: Any) -> bool:
    if isinstance(usual, float) and given is not None:
        return usual == pytest.approx(given, rel=2e-3)  # 0.316 stands for the root of a tenth
    return type(usual) is type(given) and usual == given  # True is 1 to Python


DIFFERENT = {
    "AffineSettings.when",
    "BackgroundSettings.min_gaussians",
    "DeformableSettings.has_body_pose",
    "DeformableSettings.min_displacement",
    "DeformableSettings.min_gaussians",
    "DeformableSettings.min_instance_gaussians",
    "DensityControl.pause_after_reset",
    "Depth.nearest_rendered",
    "FieldSettings.max_gaussians",
    "FieldSettings.min_gaussians",
    "ImagePointSettings.cache",
    "ImagePoints.initial_opacity",
    "RigidSettings.min_displacement",
    "RigidSettings.min_gaussians",
    "RigidSettings.min_instance_gaussians",
    "SkySettings.resolution",
    "SmplSettings.min_gaussians",
    "SmplSettings.min_instance_gaussians",
    "SmplSettings.sh_degree",
    "VibratingDensity.split_scale",
    "VibratingSettings.max_gaussians",
    "VibratingSettings.min_gaussians",
    "VibratingSettings.num_points",
}
"""Options that no method of conf/ leaves as they are by themselves."""


def test_every_option_of_the_parts():
    found: dict[str, tuple[Any, list]] = {}
    losses = "loss=[photometric,sky,depth,mask_sparsity,opacity_entropy,inverse_depth_smoothness,dynamic_region]"
    for method, capacity in (("omnire", "paper"), ("omnire", "small"), ("pvg", "paper"), ("deformgs", "small")):
        chosen = ["folder=.", "schedule=paper", f"capacity={capacity}", f"method={method}", "sparsify=masks", losses]
        with configuration():
            values(OmegaConf.to_container(compose("train", chosen), resolve=True), found)
    assert len(found) > 150
    same = {option for option, (usual, given) in found.items() if any(alike(usual, one) for one in given)}
    assert found.keys() - same == DIFFERENT
