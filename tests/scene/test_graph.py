from dataclasses import replace

import pytest
import torch

from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from sparsestreet.types import Shutter
from tests.scene.street import background, degree, keyframes, pose, random_rows, rigid, static_mask, track, view_at
from tests.typed import there

MASK = static_mask(sparsity_weight=0.25)
VIEW = view_at(0.0)


def cars(count: int) -> Rigid:
    rows = random_rows(count, 1, instances=torch.zeros(count, dtype=torch.int64))
    return rigid(rows, keyframes([track("car", [0, 1], [pose(0, (5.0, 0, 0))] * 2)], 2), max_gap=1.0)


def test_spans_tile_the_rows_of_three_nodes_of_different_sizes():
    nodes = {"road": background(random_rows(4, 0)), "cars": cars(3), "trees": background(random_rows(5, 2))}
    placed = SceneGraph(nodes).gaussians_at(VIEW, degree(1))
    assert placed.spans == {"road": slice(0, 4), "cars": slice(4, 7), "trees": slice(7, 12)}
    assert len(placed.gaussians) == 12
    assert SceneGraph(nodes).counts() == {"road": 4, "cars": 3, "trees": 5}
    for name, node in nodes.items():
        assert torch.equal(placed.gaussians.means[placed.spans[name]], node.gaussians_at(VIEW, degree(1)).means)


def test_nodes_of_different_degree_are_padded():
    road = background(random_rows(2, 0, sh_degree=2))
    tree = background(random_rows(2, 1, sh_degree=0))
    scene = SceneGraph({"road": road, "tree": tree})
    sh = scene.gaussians_at(VIEW).gaussians.dense_sh()
    assert sh.shape == (4, 9, 3)
    assert (sh[2:, 1:] == 0).all()
    assert torch.equal(sh[2:, :1], tree.rows.sh_dc)
    assert scene.gaussians_at(VIEW, degree(1)).gaussians.dense_sh().shape == (4, 4, 3)


@pytest.mark.parametrize("counts", [(0, 0), (0, 3), (3, 0)])
def test_empty_nodes(counts: tuple[int, int]):
    scene = SceneGraph({"road": background(random_rows(counts[0], 0)), "cars": cars(counts[1])})
    assert len(scene.gaussians_at(VIEW).gaussians) == sum(counts)


def test_no_nodes_are_an_error():
    with pytest.raises(ValueError, match="at least one node"):
        SceneGraph({})


def test_bytes_of_every_part():
    road = background(random_rows(4, 0, sh_degree=3, mask=MASK), MASK)
    scene = SceneGraph({"road": road, "cars": cars(3)}, {"sky": Sky(SkySettings(resolution=8))})
    assert scene.bytes_by_part() == {
        "road": 4 * 59 * 4,
        "cars": 3 * (3 + 3 + 4 + 1 + 12 + 1) * 4,  # degree 1 and the instance
        "poses": 2 * 8 * 4,
        "sky": 6 * 8 * 8 * 3 * 4,
    }
    assert SceneGraph({"road": road}).bytes_by_part() == {"road": 4 * 59 * 4, "poses": 0}


def test_poses_of_all_nodes_are_stored():
    longer = keyframes([track("tram", [0, 1, 2], [pose(0, (5.0, 0, 0))] * 3)], 3)
    trams = rigid(random_rows(2, 1, instances=torch.zeros(2, dtype=torch.int64)), longer)
    assert SceneGraph({"cars": cars(3), "trams": trams}).bytes_by_part()["poses"] == (2 + 3) * 8 * 4


def test_names_of_the_parameters():
    """The optimizer's groups and checkpoints go by these."""
    scene = SceneGraph(
        {"road": background(random_rows(1, 0)), "cars": cars(1)}, {"sky": Sky(SkySettings(resolution=2))}
    )
    names = {name for name, _ in scene.named_parameters()}
    assert {"effects.sky.texels", "nodes.road.rows.means", "nodes.cars.rotation_deltas"} <= names
    assert len(names) == 1 + 6 + 8


def test_a_lone_node_left_out_has_no_rows_and_no_mask():
    scene = SceneGraph({"road": background(random_rows(4, 0, mask=MASK), MASK)})
    left = scene.without("road").nodes["road"]
    assert (len(left.rows), left.mask) == (0, None)
    assert (len(scene.nodes["road"].rows), scene.nodes["road"].mask) == (4, MASK)


def rolling(time: float, span: float):
    """A view whose readout takes a normalized time."""
    view = view_at(time)
    shutter = Shutter(torch.tensor([0.1, 0.0, 0.0]), torch.zeros(3), span=span)
    return replace(view, camera=replace(view.camera, shutter=shutter))


def test_rows_of_objects_move_while_an_image_is_read_out():
    """A car that drives 4 m and turns by 90 degrees from time 0 to 1: its rows' places at both ends, by their poses."""
    rows = random_rows(6, 1, instances=torch.zeros(6, dtype=torch.int64))
    path = keyframes([track("car", [0, 1], [pose(0, (5.0, 0, 0)), pose(90, (9.0, 0, 0))])], 2)
    scene = SceneGraph({"road": background(random_rows(4, 0)), "cars": rigid(rows, path, max_gap=1.0)})
    moved = there(scene.gaussians_at(rolling(0.4, span=0.1)).gaussians.displacements)
    ends = [scene.gaussians_at(view_at(time)).gaussians.means for time in (0.35, 0.45)]
    torch.testing.assert_close(moved, (ends[1] - ends[0]).detach())
    assert (moved[:4] == 0).all()
    assert (moved[4:].norm(dim=1) > 0.1).all()
    assert not moved.requires_grad


def test_nothing_is_asked_for_its_motion_where_nothing_is_read_out_in_turn():
    scene = SceneGraph({"cars": cars(3)})
    for view in (view_at(0.4), rolling(0.4, span=0.0)):
        assert scene.gaussians_at(view).gaussians.displacements is None
