"""Given numbers of Gaussians, at random and by opacity; and which nodes a rule touches."""

import pytest
import torch

from sparsestreet.pruning import OpacityRule, RandomRule, RenderContext
from sparsestreet.scene.graph import SceneGraph
from tests.scene.street import background, random_rows


def street() -> SceneGraph:
    """Two nodes of 20 and 10 Gaussians, and one that must not be pruned."""
    settled = background(random_rows(5, 2), prunable=False)
    return SceneGraph(
        {"road": background(random_rows(20, 0)), "trees": background(random_rows(10, 1)), "sign": settled}
    )


@pytest.mark.parametrize("make", [RandomRule, OpacityRule])
@pytest.mark.parametrize(
    ("keep", "kept"),
    [
        (0.5, {"road": 10, "trees": 5}),
        (7, {"road": 7, "trees": 7}),
        (15.0, {"road": 15, "trees": 10}),
        (1.0, {"road": 20, "trees": 10}),
        (0.0, {"road": 0, "trees": 0}),
        ({"road": 6, "trees": 0.3}, {"road": 6, "trees": 3}),
        ({"trees": 0.3}, {"road": 20, "trees": 3}),
    ],
)
def test_so_many_stay(make, keep, kept):
    selections = make(keep=keep).select(street(), [], RenderContext())
    assert {name: int(each.keep.sum()) for name, each in selections.items()} == kept
    assert not any(each.floor_hit for each in selections.values())


def test_the_most_opaque_stay_and_of_equals_the_lower_row():
    scene = street()
    with torch.no_grad():
        scene.nodes["road"].rows.opacity_logits[:] = torch.tensor([0.0, 2.0, 1.0, 2.0, 1.0, *[-1.0] * 15])
    for number, kept in ((2.0, [1, 3]), (3.0, [1, 2, 3]), (6.0, [0, 1, 2, 3, 4, 5])):
        selection = OpacityRule(keep={"road": number}).select(scene, [], RenderContext())["road"]
        assert selection.keep.nonzero().squeeze(1).tolist() == kept


def test_a_seed_decides_and_nodes_draw_on_their_own():
    def kept(seed: int) -> dict[str, list[bool]]:
        scene = SceneGraph({"road": background(random_rows(20, 0)), "trees": background(random_rows(20, 0))})
        selections = RandomRule(keep=0.5, seed=seed).select(scene, [], RenderContext())
        return {name: each.keep.tolist() for name, each in selections.items()}

    assert kept(0) == kept(0) != kept(1)
    assert kept(0)["road"] != kept(0)["trees"]


def test_every_row_has_the_same_chance():
    scene = SceneGraph({"road": background(random_rows(20, 0))})
    rules = (RandomRule(keep=0.25, seed=seed) for seed in range(400))
    share = torch.stack([rule.select(scene, [], RenderContext())["road"].keep for rule in rules]).double().mean(0)
    # Four standard deviations of 400 draws at 0.25.
    assert float((share - 0.25).abs().max()) < 4 * (0.25 * 0.75 / 400) ** 0.5


def test_the_floor_holds():
    scene = SceneGraph({"road": background(random_rows(20, 0), min_gaussians=12)})
    selection = RandomRule(keep=0.5).select(scene, [], RenderContext())["road"]
    assert (int(selection.keep.sum()), selection.floor_hit) == (12, True)


def test_a_rule_touches_the_prunable_nodes_that_it_is_told():
    for nodes, touched in ((None, ["road", "trees"]), (["trees"], ["trees"]), (["sign", "other"], []), ([], [])):
        assert list(RandomRule(keep=0.5, nodes=nodes).select(street(), [], RenderContext())) == touched


@pytest.mark.parametrize("keep", [-0.1, {"road": float("nan")}])
def test_impossible_numbers_are_refused(keep):
    with pytest.raises(ValueError, match="keep must be a fraction"):
        OpacityRule(keep=keep)


def test_poisoned_opacities_are_refused():
    scene = street()
    with torch.no_grad():
        scene.nodes["trees"].rows.opacity_logits[3] = float("nan")
    with pytest.raises(ValueError, match="row 3 of 10 is NaN"):
        OpacityRule(keep=0.5).select(scene, [], RenderContext())
