"""A node's objects keep their rows and names through density control, pruning and storage."""

from pathlib import Path
from typing import Any

import pytest
import torch

from sparsestreet.ops import SplatSettings
from sparsestreet.scene.density import DensityStatistics, GradientDensity
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Rigid
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, load_scene, save_scene
from tests.scene.street import (
    background,
    background_settings,
    keyframes,
    pose,
    random_rows,
    rigid,
    rigid_settings,
    static_mask,
    street_log,
    track,
    training_data,
)
from tests.typed import as_a

NAMES = ["tram 7", "car/A", "car B"]
SIZES = torch.tensor([[20.0, 3.0, 3.0], [4.0, 2.0, 1.5], [4.0, 2.0, 1.5]])


def three_objects(masked: bool = False, **changes) -> Rigid:
    """Rows 0 to 8 belong to objects 0, 1, 2, 0, 1, 2 ...; every row's mean says whose it is."""
    ids = torch.arange(9) % 3
    mask = static_mask() if masked else None
    rows = random_rows(9, 0, instances=ids, mask=mask)
    with torch.no_grad():
        rows.means.copy_(0.1 * ids[:, None].float().expand(-1, 3))
        rows.log_scales.fill_(-9.0)  # children of a split stay where they are
    tracks = [track(name, [0, 1], [pose(0, (5.0 * i, 0, 0))] * 2) for i, name in enumerate(NAMES)]
    return rigid(rows, keyframes(tracks, 2), SIZES, names=NAMES, mask=mask, **changes)


def assert_whose(node: Rigid, ids: list[int]) -> None:
    """Rows and names belong together, by number as by position."""
    instances = node.instances()
    assert instances.names == tuple(NAMES)
    assert torch.equal(instances.sizes, SIZES)
    assert instances.ids.tolist() == ids
    assert instances.counts().tolist() == [ids.count(i) for i in range(3)]
    torch.testing.assert_close(node.rows.means[:, 0], 0.1 * torch.tensor(ids).float(), atol=1e-3, rtol=0)


def test_names_are_those_of_the_tracks():
    settings = rigid_settings(classes=("Car", "Cyclist"), box_points=5)
    node = settings.build(training_data(movers=settings), torch.Generator().manual_seed(0))
    taken = [each for each in street_log().tracks if each.path_length > 1]
    assert node.instances().names == tuple(each.name for each in taken) == ("driving", "bicycle")
    assert torch.equal(node.instances().sizes, torch.stack([each.size for each in taken]))


def test_without_names_objects_have_numbers():
    tracks = [track("x", [0], [pose(0, (0, 0, 0))]), track("y", [0], [pose(0, (0, 0, 0))])]
    node = rigid(random_rows(0, 0, instances=torch.zeros(0, dtype=torch.int64)), keyframes(tracks, 2))
    assert node.instances().names == ("0", "1")


@pytest.mark.parametrize(("names", "sizes"), [(["a"], SIZES), (["a", "b", "c"], SIZES[:2]), (["a"] * 4, SIZES)])
def test_every_object_has_a_name_and_a_size(names: list[str], sizes: torch.Tensor):
    tracks = [track("x", [0], [pose(0, (0, 0, 0))])] * 3
    rows = random_rows(0, 0, instances=torch.zeros(0, dtype=torch.int64))
    message = f"got {len(sizes)} sizes and {len(names)} names for 3 instances"
    with pytest.raises(ValueError, match=message):
        rigid(rows, keyframes(tracks, 2), sizes, names=names)


def test_through_densify_cull_masks_and_storage(tmp_path: Path):
    node = three_objects(masked=True)
    assert_whose(node, [0, 1, 2] * 3)
    statistics = DensityStatistics(9)
    statistics.gradient_sum[:] = torch.tensor([0.0, 0, 1, 0, 1, 0, 0, 0, 0])  # rows 2 and 4 are cloned
    statistics.visits += 1
    density = GradientDensity()
    when = {"radius": 10.0, "progress": 0.5}
    generator = torch.Generator().manual_seed(0)
    plan = density.densify(node.rows, statistics, max_gaussians=None, generator=generator, **when)
    node.rows.resize(plan)
    statistics.resize(plan)
    assert_whose(node, [0, 1, 2] * 3 + [2, 1])
    with torch.no_grad():
        node.rows.opacity_logits[[0, 3, 9]] = -10.0
    node.rows.resize(density.cull(node.rows, statistics, **when))
    assert_whose(node, [1, 2, 1, 2, 0, 1, 2, 1])
    with torch.no_grad():
        node.rows.mask_logits[4] = -10.0  # the last row of the tram
    node.rows.resize(node.mask.keep(node.rows).plan())
    assert_whose(node, [1, 2, 1, 2, 1, 2, 1])
    stored = StoredScene(SceneGraph({"cars": node}), RenderOptions(SplatSettings()), "hand-made", 2)
    save_scene(tmp_path / "scene.safetensors", stored)
    assert_whose(as_a(Rigid, load_scene(tmp_path).scene.nodes["cars"]), [1, 2, 1, 2, 1, 2, 1])


def test_rows_outside_of_their_box_by_more_than_the_margin():
    node = three_objects(box_margin=0.25)
    assert node.outside().tolist() == [False] * 9
    with torch.no_grad():
        node.rows.means[0] = torch.tensor([10.2, 0.0, 0.0])  # within the margin of the tram
        node.rows.means[1] = torch.tensor([0.0, 0.0, -1.01])  # 0.75 + 0.25 below the car
        node.rows.means[2] = torch.tensor([9.0, 0.0, 0.0])  # in the tram, but it belongs to a car
        node.rows.means[3] = torch.tensor([0.0, -1.76, 0.0])  # beside the tram
    assert node.outside().tolist() == [False, True, True, True] + [False] * 5
    assert three_objects(box_margin=100.0).outside().tolist() == [False] * 9
    node.rows.resize(RowPlan.keep(~node.outside()))
    assert node.instances().ids.tolist() == [0, 1, 2, 0, 1, 2]
    assert not node.outside().any()


def test_outside_looks_at_the_box_frame_wherever_the_box_is():
    node = three_objects()
    with torch.no_grad():
        node.keyframe_translations += 1000.0
    assert not node.outside().any()


def test_what_stands_still_has_neither_objects_nor_bounds():
    node = background(random_rows(3, 0))
    assert node.outside() is None
    assert node.instances() is None
    assert node.pose_bytes() == 0
    assert node.header() == {}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"min_gaussians": -1}, "min_gaussians must be >= 0, got -1"),
        ({"max_gaussians": 0}, "max_gaussians must be >= 1 or null, got 0"),
        ({"sharp_shape": -1.0}, r"got -1\.0 and 10\.0"),
        ({"max_axis_ratio": 0.5}, r"ratio >= 1, got 0\.0 and 0\.5"),
        ({"sharp_shape_every": 0}, "sharp_shape_every counts steps"),
        ({"temporal_smooth": -0.1}, "temporal_smooth is a weight"),
    ],
)
def test_settings_that_cannot_be(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        rigid_settings(**changes)


def test_the_floor_of_a_node_may_be_above_its_limit():
    """The paper's K_min of moving objects is above that of a small run: then nothing is removed (training/floors)."""
    assert rigid_settings(min_gaussians=5, max_gaussians=4).max_gaussians == 4


def test_a_node_is_said_by_its_fields_only():
    """Positional settings would let a new field change the meaning of an old configuration."""
    with pytest.raises(TypeError):
        type(background_settings())(("Car",))  # pyright: ignore[reportCallIssue]
