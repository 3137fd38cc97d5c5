"""A street that a network deforms: which rows, from when on, where it looks, what is learned, what a file keeps."""

from typing import Any

import pytest
import torch

from sparsestreet.geometry import quaternions
from sparsestreet.geometry.quaternions import normalized
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.nodes import Field, FieldSettings, NetworkSettings
from sparsestreet.scene.rendering import render
from sparsestreet.scene.state import FINISHED, SceneState
from tests.scene.street import RATES, background_settings, camera_at, random_rows, street_log, training_data, view_at
from tests.typed import as_a, there

CENTER, HALF, NUM_FRAMES = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([4.0, 2.0, 0.5]), 21
AXES = quaternions.to_matrix(normalized(torch.tensor([0.9, 0.1, -0.3, 0.2])))
"""Of the box, as columns in the world."""
BOX = torch.cat((AXES.T, -(AXES.T @ CENTER)[:, None]), 1) / HALF[:, None]
NETWORK = NetworkSettings(width=16, depth=3, skip=1, position_octaves=4, time_octaves=3)


def field_settings(**changes) -> FieldSettings:
    said = {"kind": FieldSettings, "network": NETWORK, "learning_rates": RATES | {"network": LearningRate(0.01)}}
    return as_a(FieldSettings, background_settings(**(said | changes)))


def street(count: int = 30, *, awake: bool = True, **changes) -> Field:
    """With ``awake``, weights in the last layer too: by some decimeters."""
    node = Field(
        field_settings(**changes),
        random_rows(count, 0),
        box_from_world=BOX,
        frame_periods=NUM_FRAMES - 1.0,
        seed=5,
    )
    if awake:
        with torch.no_grad():
            generator = torch.Generator().manual_seed(1)
            node.network.last.weight.copy_(0.3 * torch.randn(10, 16, generator=generator))
            node.network.last.bias.copy_(0.1 * torch.randn(10, generator=generator))
    return node


def state(progress: float, training: bool = False) -> SceneState:
    return SceneState(progress, 1, training)


def contracted(points: torch.Tensor) -> torch.Tensor:
    scaled = (points.double() - CENTER) @ AXES.double() / HALF
    length = scaled.norm(dim=1, keepdim=True)
    return torch.where(length <= 1, scaled, (2 - 1 / length) * scaled / length) / 4 + 0.5


@pytest.mark.parametrize("reach", [None, 1000.0])
def test_all_rows_are_deformed_by_what_the_network_says_of_their_place(reach: float | None):
    node = street(reach=reach)
    raw, stored = node.raw_at(view_at(0.3), FINISHED), node.stored(view_at(0.3))
    change = node.network(contracted(node.rows.means.detach()).float(), 0.3)
    # Rounding of a position is 512 times as large behind nine octaves; here are four.
    close: dict[str, Any] = {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(raw.means, stored.means + change.means, **close)
    torch.testing.assert_close(raw.quaternions, normalized(stored.quaternions) + change.quaternions, **close)
    torch.testing.assert_close(raw.log_scales, stored.log_scales + change.log_scales, **close)
    assert torch.equal(raw.opacity_logits, stored.opacity_logits)
    assert (raw.means - stored.means).abs().max() > 0.1


def test_the_box_of_the_scene_is_the_middle_half_and_all_else_lies_around_it():
    """Each side by its own length, so half a meter of height is worth four meters along the street."""
    node = street()
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    ellipsoid = directions * HALF @ AXES.T
    inside, border, far = (node._contracted(CENTER + r * ellipsoid) - 0.5 for r in (0.5, 1.0, 1e6))
    torch.testing.assert_close(inside, 0.125 * directions)
    torch.testing.assert_close(border, 0.25 * directions)
    torch.testing.assert_close(far, 0.5 * directions)
    torch.testing.assert_close(node._contracted(node.rows.means).double(), contracted(node.rows.means))


def test_switching_on_changes_no_pixel():
    node = street(awake=False)
    scene = SceneGraph({"street": node})
    view = view_at(0.3, camera_at(-6.0))
    before, after = (render(scene, view, state(progress)).rgb for progress in (0.09, 0.1))
    # Quaternions are of unit length from then on, which rounds them.
    torch.testing.assert_close(after, before, rtol=0, atol=1e-5)
    assert before.any()


def test_it_rests_until_its_time_comes():
    node = street(deform_from=0.4)
    assert torch.equal(node.raw_at(view_at(0.3), state(0.39)).means, node.rows.means)
    assert not torch.equal(node.raw_at(view_at(0.3), state(0.4)).means, node.rows.means)


def test_rows_far_beside_the_view_stay_and_the_image_is_the_same():
    """Rows all around the camera; those ahead, or near, or so large that they reach into the view, are deformed."""
    node, whole = street(400, reach=2.0), street(400, reach=None)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        node.rows.means.copy_(60 * torch.rand(400, 3, generator=generator) - 30)
        node.rows.log_scales[:40] = 2.0  # 7 m
        node.rows.opacity_logits.fill_(-2.0)
    whole.load_state_dict(node.state_dict())
    view = view_at(0.6, camera_at(0.0))
    images = [render(SceneGraph({"street": n}), view).rgb for n in (node, whole)]
    assert torch.equal(images[0], images[1])
    assert images[0].any()
    moved = (node.raw_at(view, FINISHED).means != node.rows.means).any(1)
    assert 50 < moved[40:].sum() < 250
    assert moved[:40].float().mean() > moved[40:].float().mean() + 0.2
    assert not torch.equal(moved, (whole.raw_at(view, FINISHED).means != whole.rows.means).any(1))


def test_the_longest_axis_of_a_row_says_how_far_it_reaches():
    """10 m behind the camera, reach 2 m: three standard deviations of 3 m come near enough, of 1 cm they do not."""
    node = street(2, reach=2.0)
    with torch.no_grad():
        node.rows.means.copy_(torch.tensor([-10.0, 0.0, 1.5]).expand(2, 3))
        node.rows.log_scales.copy_(torch.tensor([[3.0, 0.01, 0.01], [0.01, 0.01, 0.01]]).log())
    moved = (node.raw_at(view_at(0.6, camera_at(0.0)), FINISHED).means != node.rows.means).any(1)
    assert moved.tolist() == [True, False]


def test_only_training_shows_the_network_another_time_and_less_so_later():
    node = street(time_noise=0.5, time_noise_until=0.8)
    early = torch.tensor([node._time_noise(state(0.2 + step * 1e-5)) for step in range(600)])
    # 0.5 of a frame, of which (0.8 - 0.2) / 0.8 are left; standard error of a deviation 1 / sqrt(1200).
    assert float(early.std()) == pytest.approx(0.5 * 0.75 / 20, rel=4 / 1200**0.5)
    assert abs(float(early.mean())) < 4 * float(early.std()) / 600**0.5
    assert node._time_noise(state(0.8)) == node._time_noise(state(0.9)) == 0.0
    assert street(time_noise_until=0.0)._time_noise(state(0.0)) == 0.0
    means = node.raw_at(view_at(0.3), state(0.2, training=True)).means
    shifted = node.raw_at(view_at(0.3 + node._time_noise(state(0.2))), state(0.2)).means
    assert torch.equal(means, shifted)
    assert not torch.equal(means, node.raw_at(view_at(0.3), state(0.2)).means)
    assert street(time_noise=0.5, time_noise_until=0.8)._time_noise(state(0.2)) == node._time_noise(state(0.2))


def test_gradients_reach_rows_and_network_but_not_positions_through_it():
    node = street()
    raw = node.raw_at(view_at(0.3), FINISHED)
    (raw.means.sum() + raw.log_scales.sum() + raw.quaternions.square().sum()).backward()
    assert torch.equal(there(node.rows.means.grad), torch.ones(30, 3))
    assert torch.equal(there(node.rows.log_scales.grad), torch.ones(30, 3))
    assert all(parameter.grad.any() for parameter in node.network.parameters())
    assert node.rows.quaternions.grad.any()
    assert node.rows.opacity_logits.grad is None


def test_it_starts_as_the_background_and_knows_its_log():
    data, settings = training_data(), field_settings(lidar=40, near=20)
    node = settings.build(data, torch.Generator().manual_seed(3))
    still = background_settings(lidar=40, near=20).build(data, torch.Generator().manual_seed(3))
    assert torch.equal(node.rows.means, still.rows.means)
    log = street_log()
    assert torch.equal(node.box_from_world, log.box_from_world)
    assert node.frame_periods == 4
    again = settings.build(data, torch.Generator().manual_seed(3))
    assert torch.equal(again.network.first.of_row.weight, node.network.first.of_row.weight)
    assert again.seed == node.seed
    assert node.pose_bytes() == 4 * sum(parameter.numel() for parameter in node.network.parameters())


def test_rows_come_and_go():
    node = street(5)
    node.rows.resize(RowPlan(5, torch.tensor([3, 3]), torch.tensor([False, True])))
    raw = node.raw_at(view_at(0.3), FINISHED)
    torch.testing.assert_close(raw.means[0], raw.means[1])  # a product of matrices sums rows in their own order
    assert len(street(0).raw_at(view_at(0.3), state(0.5, training=True))) == 0


def test_a_reach_that_cannot_be():
    with pytest.raises(ValueError, match=r"reach is a distance in meters and must be >= 0, got -1\.0"):
        field_settings(reach=-1.0)


def test_a_scene_of_the_time_of_the_ball_says_so():
    node = street()
    tensors = {name: values for name, values in node.state_dict().items() if name != "box_from_world"}
    with pytest.raises(ValueError, match=r"trained in a ball, .*: train it again"):
        node.settings.restore(node.rows, tensors, node.header())
