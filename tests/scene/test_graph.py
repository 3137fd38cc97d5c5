import pytest
import torch

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes import Background, Rigid
from sparsestreet.scene.sky import Sky, SkySettings
from tests.scene.street import keyframes, pose, random_rows, track

MASK = StaticMask(weight=0.25, min_gaussians=0)


def rigid(count: int) -> Rigid:
    rows = random_rows(count, 1, instances=torch.zeros(count, dtype=torch.int64))
    return Rigid(rows, keyframes([track("car", [0, 1], [pose(0, (5.0, 0, 0))] * 2)], 2), torch.ones(1, 3), max_gap=1.0)


def test_nodes_in_their_order():
    scene = SceneGraph({"road": Background(random_rows(4, 0), None), "cars": rigid(3)}, active_sh_degree=1)
    placed = scene.gaussians_at(0.0)
    assert placed.rows == {"road": slice(0, 4), "cars": slice(4, 7)}
    assert scene.counts() == {"road": 4, "cars": 3}
    assert torch.equal(placed.gaussians.means[:4], scene.nodes["road"].rows.means)
    assert torch.equal(placed.gaussians.means[4:], scene.nodes["cars"].gaussians_at(0.0, 1).means)


def test_nodes_of_different_degree_are_padded():
    road = Background(random_rows(2, 0, sh_degree=2), None)
    tree = Background(random_rows(2, 1, sh_degree=0), None)
    scene = SceneGraph({"road": road, "tree": tree})
    sh = scene.gaussians_at(0.0).gaussians.sh
    assert sh.shape == (4, 9, 3)
    assert (sh[2:, 1:] == 0).all()
    assert torch.equal(sh[2:, :1], tree.rows.sh_dc)
    scene.active_sh_degree = 1
    assert scene.gaussians_at(0.0).gaussians.sh.shape == (4, 4, 3)


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (3, 0)])
def test_empty_nodes(counts: tuple[int, int]):
    scene = SceneGraph({"road": Background(random_rows(counts[0], 0), None), "cars": rigid(counts[1])})
    assert len(scene.gaussians_at(0.0).gaussians) == sum(counts)


def test_no_nodes_are_an_error():
    with pytest.raises(ValueError, match="at least one node"):
        SceneGraph({})


def test_mask_terms_of_masked_nodes_only():
    road = Background(random_rows(4, 0, mask=MASK), MASK)
    scene = SceneGraph({"road": road, "cars": rigid(3)})
    terms = scene.mask_terms()
    assert list(terms) == ["road"]
    assert terms["road"].weight == 0.25
    (gradient,) = torch.autograd.grad(terms["road"].scores.sum(), road.rows.mask_logits)
    sigma = torch.sigmoid(torch.tensor(1.0))
    torch.testing.assert_close(gradient, (sigma * (1 - sigma)).expand(4))
    road.rows.drop_column("mask_logits")
    assert scene.mask_terms() == {}


def test_bytes_of_every_part():
    road = Background(random_rows(4, 0, sh_degree=3, mask=MASK), MASK)
    scene = SceneGraph({"road": road, "cars": rigid(3)}, Sky(SkySettings(8)))
    assert scene.bytes_by_part() == {
        "road": 4 * 59 * 4,
        "cars": 3 * (3 + 3 + 4 + 1 + 12 + 1) * 4,  # degree 1 and the instance
        "poses": 2 * 8 * 4,
        "sky": 6 * 8 * 8 * 3 * 4,
    }
    assert SceneGraph({"road": road}).bytes_by_part() == {"road": 4 * 59 * 4, "poses": 0, "sky": 0}


def test_names_of_the_parameters():
    """The optimizer's groups and checkpoints go by these."""
    scene = SceneGraph({"road": Background(random_rows(1, 0), None), "cars": rigid(1)}, Sky(SkySettings(2)))
    names = {name for name, _ in scene.named_parameters()}
    assert {"sky.texels", "nodes.road.rows.means", "nodes.cars.rotation_deltas"} <= names
    assert len(names) == 1 + 6 + 8
