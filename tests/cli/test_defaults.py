"""A training from Python starts from what the command starts from: the defaults of the classes and of conf/ are one."""

import inspect
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from sparsestreet.cli.config.compose import composed
from sparsestreet.cli.runs.run import recipe_of
from sparsestreet.scene import effects
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.nodes import BackgroundSettings, RigidSettings
from sparsestreet.training.callbacks import DensityControl, PhaseTimes, RowLedger
from sparsestreet.training.losses import Depth, Photometric, SkyMask
from sparsestreet.training.moved_views import MovedViews
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.schedule import Interval
from sparsestreet.triangulation import ImagePointSettings
from tests.typed import as_a


@pytest.fixture(scope="module")
def cfg():
    return composed(["schedule=paper", "sparsify=masks"])


def streetgs() -> Recipe:
    """StreetGS in Python: parts by their names, and of their numbers those alone that have no default."""
    control = DensityControl(Interval(0.04, 0.9, 100), 0.6, Interval(0.0, 0.0, 1000))
    return Recipe(
        nodes={
            "background": BackgroundSettings(
                mask=StaticMaskSettings(sparsity_weight=2.5e-3), masked=False, density=GradientDensity()
            ),
            "rigid": RigidSettings(
                classes=["Vehicle"],
                mask=StaticMaskSettings(sparsity_weight=1e-4, visible_only=True),
                masked=False,
                density=GradientDensity(cull_scale=0.1),
            ),
        },
        effects={
            "hood": effects.HoodSettings(),
            "sky": effects.SkySettings(),
            "lens": effects.LensSettings(),
            "shutter": effects.ShutterSettings(),
            "exposure": effects.ExposureSettings(),
            "affine": effects.AffineSettings(),
            "camera_poses": effects.CameraPosesSettings(),
            "box_poses": effects.BoxPosesSettings(),
            "motion_blur": effects.MotionBlurSettings(),
            "dirt": effects.DirtSettings(),
        },
        losses={"photometric": Photometric(), "sky": SkyMask(), "depth": Depth()},
        callbacks={
            "density_control": control,
            "row_ledger": RowLedger(Path("records/counts.csv")),
            "phase_times": PhaseTimes(Path("records/phases.csv")),
        },
        image_points=ImagePointSettings(),
        moved_views=MovedViews(),
    )


def test_streetgs_from_python_is_the_commands():
    said = recipe_of(composed([]))
    # A limit that says what its absence means is the command's.
    losses = {**said.losses, "depth": replace(as_a(Depth, said.losses["depth"]), nearest_rendered=None)}
    said = replace(said, losses=losses)
    usual = streetgs()
    for entry in fields(Recipe):
        if entry.name != "callbacks":
            assert getattr(usual, entry.name) == getattr(said, entry.name), entry.name
    assert usual.callbacks.keys() == said.callbacks.keys()
    for name, callback in usual.callbacks.items():
        own, other = vars(callback), vars(said.callbacks[name])
        assert {key: own[key] for key in own if isinstance(own[key], int | float | bool | Interval)} == {
            key: other[key] for key in own if isinstance(own[key], int | float | bool | Interval)
        }


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
    "DeformableSettings.has_body_pose",
    "DeformableSettings.min_displacement",
    "DeformableSettings.min_gaussians",
    "Depth.nearest_rendered",
    "MaskSparsity.weight",
    "SmplSettings.min_gaussians",
    "SmplSettings.sh_degree",
    # Of the op: as in 3DGS. Of a training (``DEFAULT_OPTIONS``): true.
    "SplatSettings.antialias",
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
        chosen = [f"capacity={capacity}", f"method={method}", "sparsify=masks", losses]
        values(OmegaConf.to_container(composed(chosen), resolve=True), found)
    assert len(found) > 150
    same = {option for option, (usual, given) in found.items() if any(alike(usual, one) for one in given)}
    assert found.keys() - same == DIFFERENT
