"""A second run on a log starts with what the first one measured: bit for bit the same, and only as long as it holds."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from sparsestreet import kept
from sparsestreet.cli.config.compose import composed
from sparsestreet.cli.runs.run import opened
from sparsestreet.training.run import build
from tests.conftest import unchecked

pytestmark = pytest.mark.lengthy

OWN = ["data.log.settings.seed=0", "effects.exposure.when=on", "effects.camera_poses.when=on"]
"""The street stays the same when the run's seed changes; effects with a start of their own are on."""
OF_PLAN = {
    "effect-sky", "effect-hood", "effect-dirt", "effect-lens", "effect-shutter", "effect-exposure", "effect-affine",
    "effect-camera_poses", "effect-box_poses", "effect-motion_blur",
}  # fmt: skip
OF_START = {"bounds", "seeds", "boxes", "points", "returns", "edges", "gains", "poses", "doubts", "light"}
ALL = {"hoods", "dirt"} | OF_PLAN | OF_START


class Start:
    """A run up to its first step."""

    def __init__(self, words: list[str]) -> None:
        with unchecked():
            _, data, recipe = opened(composed(words))
            self.plan = recipe.plan(data)
            self.system = build(recipe, data, self.plan)
            self.decisions = recipe.decisions(self.plan, data)
        self.log = data.driving_log
        self.kept = self.log.kept


@pytest.fixture(scope="module")
def words(tiny_street, tmp_path_factory) -> list[str]:
    """Of a run whose street is its own; those that share its cache follow."""
    folder = tmp_path_factory.mktemp("twice")
    (root,) = [Path(word.partition("=")[2]) for word in tiny_street if word.startswith("data.log.root=")]
    shutil.copytree(root, folder / "street", copy_function=shutil.copy2)
    return [*tiny_street, f"data.log.root={folder / 'street'}", f"cache={folder / 'kept'}", *OWN]


@pytest.fixture(scope="module")
def first(words) -> Start:
    return Start(words)


def _state(start: Start) -> dict[str, torch.Tensor]:
    """All that training starts from, as tensors."""
    term = start.system.moved_views
    assert term is not None
    returns = term.returns
    tensors = {f"scene.{name}": value for name, value in start.system.scene.state_dict().items()}
    for index, own in {"street": returns.street, **returns.objects}.items():
        tensors[f"returns.{index}"] = torch.cat((own.points, own.colors.values, own.colors.cut_off), 1)
        tensors[f"weights.{index}"] = own.weights
    for index in returns.objects:
        tensors[f"returns.{index}.later"] = returns.objects_at(index, 0.5).points
    tensors["starts"] = torch.tensor(returns.starts)
    log = start.log
    tensors["box"] = torch.cat((log.center, torch.tensor([log.radius]), log.box_from_world.flatten()))
    return tensors


def test_found_or_computed_the_start_is_the_same(words, first):
    alone, second = Start([*words, "cache=null"]), Start(words)
    assert (set(first.kept.made), first.kept.found) == (ALL, [])
    assert (set(second.kept.found) - {"light"}, second.kept.made) == (ALL - {"light"}, [])
    assert not alone.kept
    expected = _state(alone)
    for start in (first, second):
        assert start.decisions == alone.decisions
        got = _state(start)
        assert list(got) == list(expected)
        for name, value in expected.items():
            assert got[name].dtype == value.dtype, name
            assert got[name].numpy().tobytes() == value.numpy().tobytes(), name


def test_pictures_of_a_kept_finding_are_drawn_as_before(words, first):
    second = Start(words)
    for one, other in zip(first.plan.effects, second.plan.effects, strict=True):
        assert replace(one.finding, evidence=tuple) == replace(other.finding, evidence=tuple)
        assert [panel.title for panel in one.finding.evidence()] == [panel.title for panel in other.finding.evidence()]


CHANGES = {
    "another seed": (["seed=1"], {"seeds", "returns"}),
    "a threshold": (["effects.exposure.threshold=0.04"], {"effect-exposure"}),
    "the number of points": (["node.background.num_points=1500"], {"seeds"}),
    "a limit of points from images": (["image_points.min_views=4"], {"points", "seeds"}),
    "held-out frames": (["split.offset=4"], ALL),
    "a lidar that is left out": (["data.log.lidar=false"], ALL - {"returns", "edges"}),
}


@pytest.mark.parametrize("case", CHANGES.values(), ids=CHANGES)
def test_what_changes_is_made_anew_and_nothing_else(case, words, first):
    changes, expected = case
    assert set(Start([*words, *changes]).kept.made) == expected


def test_other_code_makes_all_anew(words, first, monkeypatch):
    monkeypatch.setattr(kept, "code_version", lambda: "edited")
    assert set(Start(words).kept.made) == ALL


def test_one_image_makes_all_anew(words, first):
    """The last test: the street is changed."""
    (root,) = [Path(word.partition("=")[2]) for word in words[-5:] if word.startswith("data.log.root=")]
    path = root / "images" / "003_1.jpg"
    with Image.open(path) as image:
        changed = image.copy()
    changed.putpixel((20, 10), (255, 0, 255))
    changed.save(path)
    assert set(Start(words).kept.made) == ALL
