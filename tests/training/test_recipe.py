"""The parts of a training: what the scene and the system get of them, and which do not fit together."""

from dataclasses import replace
from typing import Any

import pytest

from sparsestreet.ops import SplatSettings
from sparsestreet.pruning import ImportanceRule
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.effects import SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.training import recipe as recipe_module
from sparsestreet.training.callbacks import DensityControl, MaskTraining, Pruning
from sparsestreet.training.losses import MaskSparsity, Photometric
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.schedule import Interval
from sparsestreet.triangulation import ImagePointSettings, StreetPoints, SweepSettings
from tests.scene.street import triangulated
from tests.training.stubs import background, street_data

PLAIN = BackgroundSettings(mask=None, masked=False, density=None, prunable=False)
MASKED = replace(PLAIN, mask=StaticMaskSettings(1e-3, threshold=0.01), masked=True)
CONTROL = DensityControl(Interval(0.0, 1.0), 1.0, Interval(0.0, 0.0))
ALWAYS = Interval(0.0, 1.0)


def test_every_part_reaches_the_scene_or_the_system(monkeypatch):
    given: list[tuple[Any, ...]] = []
    asked: list[tuple[Any, ...]] = []
    scene = SceneGraph({"background": background(3)})
    monkeypatch.setattr(recipe_module, "build_scene", lambda *args: given.append(args) or scene)
    data = street_data(7, stride=3, offset=1)
    found = StreetPoints(triangulated([]), {}, triangulated([[0.0, 0.0, 30.0]], [(0, 0, 1.5, 2.5)]))
    monkeypatch.setattr(recipe_module, "find_points", lambda *args: asked.append(args) or found)
    parts = Recipe(
        nodes={"background": PLAIN},
        effects={"sky": SkySettings(resolution=2)},
        losses={"color": Photometric(0.5)},
        optimizer=OptimizerSettings(eps=1e-9),
        options=RenderOptions(SplatSettings(near_plane=0.3), "reference"),
        sh_interval=0.17,
        seed=5,
        image_points=ImagePointSettings(sweep=SweepSettings(depth_weight=0.7)),
    )
    system = parts.build(data, parts.plan(data))
    ((*places, nodes, plan, seed, points),) = given
    assert places == [data.driving_log, data.split.train, frozenset({1, 4})]
    assert (nodes, plan, seed, points) == (parts.nodes, parts.plan(data), 5, found)
    assert asked == [(*places, parts.nodes, parts.image_points)]
    assert system.scene is scene
    assert system.losses == parts.losses
    assert system.far_depth.weight == 0.7
    assert [system.far_depth.applies(frame) for frame in data.split.train] == [True, *[False] * 4]
    assert (system.optimizer_settings, system.options) == (parts.optimizer, parts.options)
    assert (system.radius, system.sh_interval) == (data.driving_log.radius, 0.17)


def recipe(settings: BackgroundSettings, *kinds: str) -> Recipe:
    """With the parts that are named."""
    losses = {"masks": MaskSparsity()} if "loss" in kinds else {}
    callbacks = {
        "control": CONTROL,
        "masks": MaskTraining(ALWAYS),
        "pruning": Pruning([0.5], ImportanceRule(gate=False)),
    }
    return Recipe({"background": settings}, losses=losses, callbacks={k: v for k, v in callbacks.items() if k in kinds})


@pytest.mark.parametrize(
    ("settings", "kinds"),
    [
        (PLAIN, ()),
        (MASKED, ("loss", "masks")),
        (replace(MASKED, masked=False), ()),
        (replace(PLAIN, prunable=True), ("pruning",)),
        (replace(PLAIN, density=GradientDensity()), ("control",)),
        (replace(PLAIN, density=GradientDensity()), ()),
    ],
)
def test_parts_that_fit_have_no_problem(settings, kinds):
    assert recipe(settings, *kinds).problems() == []
    recipe(settings, *kinds).check()


@pytest.mark.parametrize(
    ("settings", "kinds", "said"),
    [
        (MASKED, ("masks",), ["the masks of background have no MaskSparsity among the losses"]),
        (MASKED, ("loss",), ["the masks of background have no MaskTraining among the callbacks"]),
        (PLAIN, ("loss",), ["MaskSparsity is among the losses but no node trains a mask"]),
        (PLAIN, ("masks",), ["MaskTraining is among the callbacks but no node trains a mask"]),
        (PLAIN, ("pruning",), ["Pruning is among the callbacks but its rule may touch no node"]),
        (PLAIN, ("control",), ["DensityControl is among the callbacks but every node's density is null"]),
        (PLAIN, ("control", "pruning"), ["Pruning is", "DensityControl is"]),
    ],
)
def test_each_part_that_lacks_its_counterpart_is_named(settings, kinds, said):
    found = recipe(settings, *kinds).problems()
    assert [problem[: len(start)] for problem, start in zip(found, said, strict=True)] == said
    assert all(
        "derive one of your own from sparsestreet.training." in problem for problem in found if "masks of" in problem
    )
    with pytest.raises(ValueError, match=r"; ".join(said) if len(said) == 1 else rf"^{said[0]}.*; {said[1]}"):
        recipe(settings, *kinds).check()


def test_nodes_whose_k_min_keeps_all_are_said():
    """Those that masks or a rule could touch, at or below it: never a node above it, without rows or untouched."""
    nodes = {
        "kept": replace(MASKED, min_gaussians=4000),
        "at": replace(PLAIN, min_gaussians=7, prunable=True),
        "above": replace(MASKED, min_gaussians=7),
        "none": replace(MASKED, min_gaussians=7),
        "plain": replace(PLAIN, min_gaussians=7),
    }
    counts = {"kept": 3999, "at": 7, "above": 8, "none": 0, "plain": 3}
    several = replace(recipe(MASKED, "loss", "masks", "pruning"), nodes=nodes)
    (line,) = several.left_whole(counts)
    assert "take nothing: kept (3,999 Gaussians, K_min 4,000), at (7 Gaussians, K_min 7); node.NAME" in line
    assert replace(several, callbacks={}, nodes={"at": nodes["at"]}).left_whole(counts) == []


def test_a_node_and_an_effect_of_one_name():
    parts = Recipe({"sky": PLAIN, "b": PLAIN}, effects={"sky": SkySettings(), "b": SkySettings()}, losses={})
    assert parts.problems() == ["a node and an effect are both named b, sky: rename one of them"]


def test_one_node_with_density_or_a_mask_is_enough():
    several = {"a": PLAIN, "b": replace(MASKED, density=GradientDensity(), prunable=True)}
    whole = recipe(PLAIN, "loss", "masks", "control", "pruning")
    assert replace(whole, nodes=several).problems() == []
