"""What must stay of each object follows from the pixels that it fills, by all rules alike."""

import pytest
import torch

import sparsestreet.pruning.select as rule_module
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.pruning import ImportanceRule, InstanceAreas, LeaveOneOutRule, OpacityRule, RandomRule, RenderContext
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import Camera, Frame
from tests.scene.street import background, random_rows, rigid

CONTEXT = RenderContext(options=RenderOptions(backend="reference"))
NEAR, FAR, AWAY = 0, 1, 2
RULES = [
    ImportanceRule(),
    LeaveOneOutRule(60.0),
    OpacityRule(keep=0.0),
    RandomRule(keep=0.0),
]


def objects(per_instance: int = 30, *, opacity: float = 0.6, density: float = 100.0, **changes) -> Rigid:
    """Three equal balls of Gaussians: at 4 m, at 8 m, and one behind the camera."""
    count = 3 * per_instance
    generator = torch.Generator().manual_seed(3)
    rows = Rows(
        {
            "means": (0.3 * torch.randn(per_instance, 3, generator=generator)).repeat(3, 1),
            "log_scales": torch.full((count, 3), 0.15).log(),
            "quaternions": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            "opacity_logits": torch.full((count,), opacity).logit(),
            "sh_dc": torch.full((count, 1, 3), 1.0),
            "sh_rest": torch.zeros(count, 0, 3),
        },
        {"instances": torch.repeat_interleave(torch.arange(3), per_instance)},
    )
    places = torch.tensor([[-0.8, 0.0, 4.0], [2.0, 0.0, 8.0], [0.0, 0.0, -4.0]])
    still = Trajectories(
        torch.tensor([[0.0, 1.0]] * 3),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2] * 3),
        places[:, None].expand(3, 2, 3).clone(),
        torch.ones(3, 2, dtype=torch.bool),
        torch.tensor([[0.0, 1.0]] * 3),
    )
    settings = {"prunable": True, "min_instance_gaussians": density, "max_gap": 1.0} | changes
    return rigid(rows, still, names=["near", "far", "away"], **settings)


def frame(width: int = 48, offset: float = 0.0) -> Frame:
    """Seen from the origin along z; ``offset`` meters farther back."""
    pose = torch.eye(4)
    pose[2, 3] = offset
    camera = Camera(pose, torch.tensor([[width / 2, 0, width / 2], [0, width / 2, 12], [0, 0, 1]]), width, 24)
    return Frame(camera, 0.5, 0, 0, image=torch.full((24, width, 3), 90, dtype=torch.uint8))


def test_the_area_is_the_most_pixels_that_an_instance_fills():
    areas = InstanceAreas({"cars": objects(2, density=60.0)})
    assert areas.needed
    spans = {"road": slice(0, 1), "cars": slice(1, 7)}
    for weights in ([9.0, 10.0, 5.0, 0.0, 1.5, 0.0, 0.0], [9.0, 1.0, 4.0, 2.0, 20.0, 0.0, 0.0]):
        weight = torch.tensor(weights, dtype=torch.float64)
        areas.add(weight, spans)
    floors = areas.floors()["cars"].instances
    # 15 and 5 pixels, 1.5 and 22, none; 60 Gaussians per 1,000.
    assert floors.least.tolist() == [1, 2, 0]


def test_no_more_than_an_instance_has():
    areas = InstanceAreas({"cars": objects(2, density=1e9)})
    weight = torch.tensor([1.0, 1.0, 1e-9, 0.0, 0.0, 0.0], dtype=torch.float64)
    areas.add(weight, {"cars": slice(0, 6)})
    assert areas.floors()["cars"].instances.least.tolist() == [2, 1, 0]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_no_object_is_thinned_to_nothing_and_a_far_one_keeps_less(rule):
    """The views miss nothing of what is drawn: each rule would take (almost) all. The last one is the nearest."""
    scene = SceneGraph({"road": background(random_rows(20, 0)), "cars": objects()})
    views = [frame(offset=1.0), frame()]
    least = rule.floors(scene, views, CONTEXT)["cars"].instances.least
    selection = rule.select(scene, views, CONTEXT)["cars"]
    kept = torch.bincount(scene.nodes["cars"].rows.instances[selection.keep], minlength=3)
    assert 2 <= int(least[FAR]) < int(least[NEAR]) < 30
    assert int(least[AWAY]) == 0
    assert bool((kept >= least).all())
    if not isinstance(rule, ImportanceRule):
        assert kept.tolist() == least.tolist()
        assert selection.floor_hit


def test_the_largest_view_counts_and_the_floor_grows_with_the_image():
    rule = OpacityRule(keep=0.0)
    scene = SceneGraph({"cars": objects()})
    small, large = rule.floors(scene, [frame(offset=2.0)], CONTEXT), rule.floors(scene, [frame()], CONTEXT)
    both = rule.floors(scene, [frame(), frame(offset=2.0)], CONTEXT)
    assert torch.equal(both["cars"].instances.least, large["cars"].instances.least)
    assert int(small["cars"].instances.least[NEAR]) < int(large["cars"].instances.least[NEAR])


def test_k_min_comes_on_top_of_the_floors_of_instances():
    scene = SceneGraph({"cars": objects(min_gaussians=60)})
    selection = OpacityRule(keep=0.0).select(scene, [frame()], CONTEXT)["cars"]
    assert int(selection.keep.sum()) == 60


def test_without_floors_of_instances_nothing_is_rendered(monkeypatch):
    monkeypatch.setattr(rule_module, "contribution", None)
    scene = SceneGraph({"road": background(random_rows(20, 0)), "cars": objects(density=0.0)})
    floors = OpacityRule(keep=0.5).floors(scene, [frame()], CONTEXT)
    assert {name: each.instances for name, each in floors.items()} == {"road": None, "cars": None}
    # A node without objects has no use for the setting.
    alone = SceneGraph({"road": background(random_rows(20, 0), min_instance_gaussians=5.0)})
    assert OpacityRule(keep=0.5).floors(alone, [frame()], CONTEXT)["road"].instances is None


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_a_node_whose_objects_have_no_rows(rule):
    scene = SceneGraph({"road": background(random_rows(20, 0)), "cars": objects(0)})
    selection = rule.select(scene, [frame()], CONTEXT)["cars"]
    assert (len(selection.keep), selection.removed, selection.floor_hit) == (0, 0, False)


def test_poisoned_contributions_are_refused():
    areas = InstanceAreas({"cars": objects(2)})
    weight = torch.tensor([1.0, 1.0, float("nan"), 0.0, 0.0, 0.0], dtype=torch.float64)
    areas.add(weight, {"cars": slice(0, 6)})
    areas.add(torch.ones_like(weight), {"cars": slice(0, 6)})
    with pytest.raises(ValueError, match="'far' of node 'cars' fills nan"):
        areas.floors()
    with pytest.raises(ValueError, match=r"min_instance_gaussians must be >= 0 .*, got -1"):
        objects(density=-1.0)
