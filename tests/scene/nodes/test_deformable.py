"""Objects that change their shape: from when on, by which network, what rests, what is learned, what a file keeps."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.geometry.quaternions import normalized
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import TemporalMaskSettings
from sparsestreet.scene.masks.temporal import TemporalMask
from sparsestreet.scene.nodes import Deformable, DeformableSettings, NetworkSettings
from sparsestreet.scene.rendering import render
from sparsestreet.scene.state import FINISHED, SceneState
from tests.scene.street import (
    POSE_RATES,
    RATES,
    camera_at,
    keyframes,
    pose,
    random_rows,
    rigid,
    rigid_settings,
    track,
    training_data,
    view_at,
)
from tests.typed import as_a

NETWORK = NetworkSettings(width=16, depth=3, skip=1, position_octaves=3, time_octaves=3, scales=False)
SIZES = torch.tensor([[2.0, 0.6, 1.8], [0.8, 0.8, 1.6], [1.0, 1.0, 1.0]])
TRACKS = [
    track("bicycle", [0, 2, 4], [pose(0.2 * i, (4.0 + i, -1.0, 1.0)) for i in range(3)]),
    track("walker", [1, 3], [pose(1.0, (5.0, 1.0, 1.0)), pose(1.4, (5.0, 2.0, 1.0))]),
    track("unseen", [0, 4], [pose(0.0, (9.0, 9.0, 1.0))] * 2),
]
LATER = 0.6


def deformable_settings(**changes) -> DeformableSettings:
    rates = RATES | POSE_RATES | {"network": LearningRate(0.01), "embeddings": LearningRate(0.02)}
    said = {"classes": ("Car",), "learning_rates": rates, "network": NETWORK, "features": 3}
    plain = vars(rigid_settings())
    common = {name: plain[name] for name in plain if name != "box_margin"}
    return DeformableSettings(**(common | said | changes))


def objects(count: int = 24, *, awake: bool = True, **changes) -> Deformable:
    """Rows take turns between the first two of three instances; ``awake``: the network moves them by decimeters."""
    rows = random_rows(count, 0, instances=torch.arange(count) % 2)
    with torch.no_grad():
        rows.means.mul_(0.3)
    settings = deformable_settings(**changes)
    node = Deformable(settings, rows, keyframes(TRACKS, 5), SIZES, names=("bicycle", "walker", "unseen"), max_gap=0.6)
    if awake:
        with torch.no_grad():
            generator = torch.Generator().manual_seed(1)
            node.network.last.weight.copy_(0.2 * torch.randn(node.network.last.weight.shape, generator=generator))
            node.network.last.bias.fill_(0.05)
    return node


def state(progress: float) -> SceneState:
    return SceneState(progress, 1, training=True)


def test_the_network_sees_places_by_height_time_and_instance():
    node = objects()
    raw = node.raw_at(view_at(LATER), FINISHED)
    instances = torch.arange(24) % 2
    places = 2 * node.rows.means.detach() / SIZES[instances, 2:]
    change = node.network(places, LATER, node.embeddings, instances)
    torch.testing.assert_close(raw.means, node.rows.means + change.means)
    torch.testing.assert_close(raw.quaternions, normalized(node.rows.quaternions) + change.quaternions)
    assert torch.equal(raw.log_scales, node.rows.log_scales)
    assert (raw.means - node.rows.means).abs().max() > 0.05
    assert torch.equal(raw.placement.poses.translations, node.pose_at(LATER).translations)
    with torch.no_grad():
        node.embeddings[0] += 1.0
    moved = (node.raw_at(view_at(LATER), FINISHED).means != raw.means).any(1)
    assert torch.equal(moved, instances == 0)
    assert not torch.equal(node.raw_at(view_at(0.4), FINISHED).means[1::2], raw.means[1::2])


def test_scales_are_deformed_where_the_network_says():
    node = objects(network=replace(NETWORK, scales=True))
    raw = node.raw_at(view_at(LATER), FINISHED)
    assert (raw.log_scales != node.rows.log_scales).all()


def test_it_is_rigid_until_its_time_comes_and_switching_on_changes_no_pixel():
    asleep = objects(awake=False)
    instances = torch.arange(24) % 2
    rows = random_rows(24, 0, instances=instances)
    with torch.no_grad():
        rows.means.mul_(0.3)
    still = rigid(rows, keyframes(TRACKS, 5), SIZES, max_gap=0.6)
    view = view_at(LATER, camera_at(0.0))
    images = [
        render(SceneGraph({"objects": node}), view, state(progress)).rgb
        for node, progress in ((still, 0.5), (asleep, 0.09), (objects(), 0.09), (asleep, 0.1))
    ]
    assert images[0].any()
    assert torch.equal(images[1], images[0])
    assert torch.equal(images[2], images[0])
    # Quaternions are of unit length from then on, which rounds them.
    torch.testing.assert_close(images[3], images[0], rtol=0, atol=1e-5)
    assert not torch.allclose(render(SceneGraph({"objects": objects()}), view, state(0.1)).rgb, images[0], atol=1e-3)


@pytest.mark.parametrize("detach_means", [True, False])
@pytest.mark.parametrize("refine_boxes", [True, False])
def test_gradients_reach_what_is_learned_and_nothing_else(detach_means: bool, refine_boxes: bool):
    node = objects(detach_means=detach_means, refine_boxes=refine_boxes)
    generator = torch.Generator().manual_seed(2)
    gaussians = node.gaussians_at(view_at(LATER), state(0.5))
    (gaussians.means * torch.randn(24, 3, generator=generator)).sum().backward(retain_graph=True)
    (gaussians.quaternions * torch.randn(24, 4, generator=generator)).sum().backward()
    assert all(parameter.grad.any() for parameter in node.network.parameters())
    assert node.embeddings.grad[:2].any(1).all()
    assert not node.embeddings.grad[2].any()
    assert node.rows.quaternions.grad.any()
    touched = node.rows.means.grad is not None and bool(node.rows.means.grad.any())
    assert touched == (not detach_means)
    for corrections in (node.rotation_deltas, node.translation_deltas):
        assert (corrections.grad is not None and bool(corrections.grad.any())) == refine_boxes
    node.zero_grad()
    node.gaussians_at(view_at(LATER), state(0.05)).means.sum().backward()
    assert node.rows.means.grad.any()
    assert node.embeddings.grad is None


def test_gradients_are_those_of_finite_differences():
    node = objects(4, detach_means=False, network=replace(NETWORK, position_octaves=0)).double()
    leaves = {"embeddings": node.embeddings, "network.first.of_row.weight": node.network.first.of_row.weight}

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        raw = torch.func.functional_call(node, dict(zip(leaves, values, strict=True)), (view_at(LATER), FINISHED))
        return raw.means, raw.quaternions

    node.forward = node.raw_at
    assert torch.autograd.gradcheck(outputs, list(leaves.values()))


def test_the_regularizer_is_what_deformed_rows_lie_outside():
    node = objects(outside_weight=0.5)
    raw = node.raw_at(view_at(LATER), FINISHED)
    half = SIZES[torch.arange(24) % 2].double() / 2
    beyond = (raw.means.detach().double().abs() - half).clamp(min=0)
    assert 0.1 < float((beyond > 0).double().mean()) < 0.9
    term = node.own_regularizers(raw, torch.ones(24, dtype=torch.bool), FINISHED)["out_of_box"]
    assert float(term.detach()) == pytest.approx(0.5 * float(beyond.sum()) / 72, rel=1e-6)
    term.backward()
    assert node.network.last.weight.grad.any()
    assert node.outside() is None


def test_it_starts_as_a_rigid_node_and_its_weights_are_those_of_the_seed():
    settings = deformable_settings()
    data = training_data(movers=settings)
    node, again, other = (settings.build(data, torch.Generator().manual_seed(seed)) for seed in (3, 3, 4))
    still = rigid_settings().build(data, torch.Generator().manual_seed(3))
    assert torch.equal(node.rows.means, still.rows.means)
    assert torch.equal(node.keyframe_times, still.keyframe_times)
    assert node.embeddings.shape == (1, 3)
    assert ((node.embeddings >= 0) & (node.embeddings < 1)).all()
    for name in ("embeddings", "network.first.of_row.weight"):
        assert torch.equal(again.get_parameter(name), node.get_parameter(name))
        assert not torch.equal(other.get_parameter(name), node.get_parameter(name))
    assert settings.build(training_data(movers=replace(settings, classes=("Tram",))), torch.Generator()) is None


def test_a_mask_over_time_counts_places_from_each_box():
    """-1 and 1 at its faces."""
    settings = deformable_settings(mask=TemporalMaskSettings(1e-4), masked=True)
    node = settings.build(training_data(movers=settings), torch.Generator().manual_seed(3))
    with torch.no_grad():
        node.rows.means[:2] = torch.tensor([[0.5], [-0.5]]) * node.sizes[node.rows.instances[:2]]
    torch.testing.assert_close(
        as_a(TemporalMask, node.mask)._places(node.rows)[:2], torch.tensor([[1.0], [-1.0]]).expand(2, 3)
    )


def test_rows_come_and_go():
    node = objects(5)
    node.rows.resize(RowPlan(5, torch.tensor([3, 3, 0]), torch.tensor([False, True, True])))
    raw = node.raw_at(view_at(LATER), FINISHED)
    torch.testing.assert_close(raw.means[0], raw.means[1])  # a product of matrices sums rows in their own order
    network = sum(parameter.numel() for parameter in node.network.parameters())
    assert node.pose_bytes() == 4 * (8 * 7 + 3 * 3 + network)
    nobody = Deformable(node.settings, objects(0).rows, keyframes([], 5), torch.zeros(0, 3))
    assert len(nobody.gaussians_at(view_at(LATER), FINISHED)) == 0
    empty = objects(0)
    raw = empty.raw_at(view_at(LATER), FINISHED)
    assert len(raw) == 0
    assert float(empty.own_regularizers(raw, torch.zeros(0, dtype=torch.bool), FINISHED)["out_of_box"].detach()) == 0.0
