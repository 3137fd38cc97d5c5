"""When closed rows go, which, and how the masks end."""

import logging

import pytest
import torch

from sparsestreet.scene.masks import SampledMaskSettings, StaticMaskSettings
from sparsestreet.scene.rendering import render
from sparsestreet.training.callbacks import MaskTraining
from sparsestreet.training.losses import MaskSparsity, Photometric
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.schedule import Interval
from tests.training.stubs import Listener, StubTrainer, background, frame_at, labels, make_system, rigid, set_rows

MASK = StaticMaskSettings(1e-3, threshold=0.01)
CLOSED = -6.0
"""sigmoid(-6) = 0.0025."""


def every_twenty() -> MaskTraining:
    """Due at 20 and 40 of 100 steps; the interval closes at 55."""
    return MaskTraining(Interval(0.1, 0.55, every=20))


def test_closed_rows_go_at_the_next_due_step_and_the_rest_at_the_close():
    node, other = background(8, mask=MASK), background(5)
    set_rows(node, "mask_logits", {2: CLOSED, 5: CLOSED})
    listener = Listener()
    trainer = StubTrainer(make_system({"background": node, "other": other}), [every_twenty(), listener])
    trainer.walk(19)
    assert labels(node) == list(range(8))
    trainer.walk(20)
    assert labels(node) == [0, 1, 3, 4, 6, 7]
    set_rows(node, "mask_logits", {0: CLOSED})
    trainer.walk(39)
    assert labels(node) == [0, 1, 3, 4, 6, 7]
    trainer.walk(40)
    assert labels(node) == [1, 3, 4, 6, 7]
    set_rows(node, "mask_logits", {4: CLOSED})  # label 7
    trainer.walk(54)
    assert node.mask is not None
    trainer.walk(55)
    assert labels(node) == [1, 3, 4, 6]
    assert node.mask is None
    trainer.walk(100)
    assert listener.reasons == [(step, "background", "mask") for step in (20, 40, 55)]
    assert len(other.rows) == 5


def test_where_nothing_is_closed_nobody_hears_of_a_change():
    node, listener = background(8, mask=MASK), Listener()
    trainer = StubTrainer(make_system({"background": node}), [every_twenty(), listener])
    means = node.rows.means
    trainer.walk(40)
    assert listener.heard == []
    assert node.rows.means is means


def test_removing_closed_rows_changes_no_image():
    node = background(20, mask=MASK)
    set_rows(node, "mask_logits", dict.fromkeys(range(0, 20, 3), CLOSED))
    trainer = StubTrainer(system := make_system({"background": node}), [every_twenty()])
    before = render(system.scene, frame_at()).rgb.detach()
    trainer.walk(20)
    assert len(node.rows) == 13
    assert float(before.max()) > 0.1
    # float32 sums of the same splats in the same order
    torch.testing.assert_close(render(system.scene, frame_at()).rgb.detach(), before, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("visible_only", [False, True])
def test_masks_end_with_their_interval_in_scene_and_optimizer(visible_only):
    """Column, group and moments are gone; what stays keeps the moments of its rows; training goes on."""
    nodes = {"background": background(8, mask=MASK), "rigid": rigid(6, mask=MASK)}
    losses = {"photometric": Photometric(), "sparsity": MaskSparsity()}
    system = make_system(nodes, losses, OptimizerSettings(visible_only=visible_only))
    trainer = StubTrainer(system, [every_twenty()])
    trainer.train(3, frame_at())
    optimizer, node = trainer.optimizers[0], nodes["background"]
    logits = [scene_node.rows.mask_logits for scene_node in nodes.values()]
    moments = optimizer.state[node.rows.means]["exp_avg"].clone()
    assert moments.any()
    assert all(logit in optimizer.state for logit in logits)
    set_rows(node, "mask_logits", {1: CLOSED, 6: CLOSED})
    trainer.walk(55)
    for scene_node in nodes.values():
        assert scene_node.mask is None
        assert "mask_logits" not in scene_node.rows.columns()
    names = {name for name, _ in system.scene.named_parameters()}
    assert not any("mask" in name for name in names)
    held = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    assert len(held) == len(names)
    assert all(any(parameter is other for other in held) for parameter in system.scene.parameters())
    assert all(any(parameter is other for other in held) for parameter in optimizer.state)
    assert torch.equal(optimizer.state[node.rows.means]["exp_avg"], moments[[0, 2, 3, 4, 5, 7]])
    before = node.rows.means.detach().clone()
    trainer.train(1, frame_at())
    assert not torch.equal(node.rows.means, before)


def test_the_floor_keeps_the_best_rows_and_is_counted_and_logged(caplog):
    """Five of eight rows are closed and K_min is 5: the best two of the closed stay."""
    node = background(8, mask=MASK, min_gaussians=5)
    set_rows(node, "mask_logits", {0: -6.0, 2: -5.0, 3: -8.0, 5: -7.0, 6: -9.0})
    trainer = StubTrainer(make_system({"background": node}), [every_twenty()])
    trainer.global_step = 17
    with caplog.at_level(logging.INFO):
        trainer.train(3, frame_at())
    assert labels(node) == [0, 1, 2, 4, 7]
    assert node.mask.floor_firings == 0
    (message,) = caplog.messages
    assert message.startswith("step 20: the floor of 5 Gaussians (K_min) of node 'background' held in 3 steps")
    with caplog.at_level(logging.INFO):
        trainer.train(20, frame_at())
    assert caplog.messages == [message], "a node below its floor holds it at each removal: that is said once"


def test_a_floor_that_held_only_before_is_logged_and_one_that_never_did_is_not(caplog):
    nodes = {"background": background(8, mask=MASK, min_gaussians=5), "rigid": rigid(4, mask=MASK, min_gaussians=4)}
    trainer = StubTrainer(make_system(nodes), [every_twenty()])
    nodes["background"].mask.floor_firings = 7
    with caplog.at_level(logging.INFO):
        trainer.walk(40)
    assert [message[:7] for message in caplog.messages] == ["step 20"]
    assert "held in 7 steps" in caplog.messages[0]


def test_a_floor_that_only_the_removal_meets_is_logged(caplog):
    """Rows that no step rendered meanwhile: the counter is 0, but the selection says that the floor held."""
    node = background(3, mask=MASK, min_gaussians=2)
    set_rows(node, "mask_logits", {0: CLOSED, 1: CLOSED - 1})
    trainer = StubTrainer(make_system({"background": node}), [every_twenty()])
    with caplog.at_level(logging.INFO):
        trainer.walk(20)
    assert labels(node) == [0, 2]
    assert len(caplog.messages) == 1


def test_sampled_masks_train_lose_what_is_never_drawn_and_end():
    node = background(8, mask=SampledMaskSettings(5e-4, initial_logit=0.0))
    losses = {"photometric": Photometric(), "sparsity": MaskSparsity()}
    trainer = StubTrainer(make_system({"background": node}, losses), [every_twenty()])
    trainer.train(2, frame_at())
    # Rows that the step did not draw have a gradient too, and so have moved.
    assert (node.rows.mask_logits != 0).all()
    set_rows(node, "mask_logits", {1: -30.0, 6: -30.0} | dict.fromkeys((0, 2, 3, 4, 5, 7), 30.0))
    trainer.walk(20)
    assert labels(node) == [0, 2, 3, 4, 5, 7]
    trainer.walk(55)
    assert node.mask is None
    assert "mask_logits" not in node.rows.columns()
