"""Rows, moments, listeners and the stale graph when a node's table changes; masks that end."""

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.records.curves import CountChange
from sparsestreet.scene.gaussians import RowPlan, Rows, Selection
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import Mask, StaticMaskSettings
from sparsestreet.scene.nodes import Background
from sparsestreet.training.callbacks import Clock
from sparsestreet.training.callbacks.density_control import end_mask, resize_rows
from tests.training.stubs import Listener, StubTrainer, background, frame_at, labels, make_rows, make_system

PLAN = RowPlan(4, torch.tensor([3, 1, 1]), torch.tensor([False, False, True]))


def test_values_moments_and_listeners_follow_one_plan():
    nodes = {"background": background(4), "other": background(3)}
    first, second = Listener(), Listener()
    trainer = StubTrainer(make_system(nodes), [first, Clock(), second])
    trainer.train(2, frame_at())
    means, rows = nodes["background"].rows.means.detach().clone(), nodes["background"].rows
    moments = trainer.optimizers[0].state[rows.means]["exp_avg"].clone()
    resize_rows(trainer, trainer.system, "background", PLAN, "because")
    assert labels(nodes["background"]) == [3, 1, 1]
    assert torch.equal(rows.means, means[[3, 1, 1]])
    moved = trainer.optimizers[0].state[rows.means]["exp_avg"]
    assert torch.equal(moved[:2], moments[[3, 1]])
    assert not moved[2].any()
    for listener in (first, second):
        ((change, plan),) = listener.heard
        assert change == CountChange(2, "background", 4, 3, "because")
        assert plan is PLAN
    assert labels(nodes["other"]) == [0, 1, 2]
    trainer.train(1, frame_at())  # the optimizer holds the new parameters
    assert not torch.equal(rows.means, means[[3, 1, 1]])


def test_a_stale_rendering_is_let_go():
    trainer = StubTrainer(make_system({"background": background(4, mask=StaticMaskSettings(1.0))}))
    trainer.train(1, frame_at())
    assert trainer.system.rendering is not None
    resize_rows(trainer, trainer.system, "background", PLAN, "because")
    assert trainer.system.rendering is None
    trainer.train(1, frame_at())
    end_mask(trainer, trainer.system, "background")
    assert trainer.system.rendering is None


def test_a_plan_for_other_rows_is_refused_and_nobody_hears_of_it():
    listener = Listener()
    trainer = StubTrainer(make_system({"background": background(5)}), [listener])
    with pytest.raises(ValueError, match="plan was made for 4 rows"):
        resize_rows(trainer, trainer.system, "background", PLAN, "because")
    assert listener.heard == []


class TwoScores(Mask):
    """A mask with two columns and a network of its own, which leaves something when it ends."""

    columns = ("near_logits", "far_logits")
    sparsity_weight = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Linear(2, 1)

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        return {name: torch.ones(num_rows) for name in self.columns}

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        return self.network(torch.stack((rows.near_logits, rows.far_logits), 1)).squeeze(1).sigmoid()

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        return self.multipliers(rows, time).sum()

    def keep(self, rows: Rows) -> Selection:
        return Selection(torch.ones(len(rows), dtype=torch.bool), False, 0)

    def finish(self, rows: Rows) -> tuple[Mask, dict[str, Tensor]]:
        finished = TwoScores()
        finished.columns = ()
        return finished.requires_grad_(False), {}


@pytest.mark.parametrize("trained", [False, True])
def test_a_masks_columns_and_parameters_leave_the_optimizer_and_its_rest_stays(trained):
    mask = TwoScores()
    settings = background(1, learning_rates=dict.fromkeys(("rows", "mask"), LearningRate(0.01))).settings
    node = Background(settings, make_rows(4, columns=mask.initial_columns(4)), mask)
    trainer = StubTrainer(make_system({"background": node, "other": background(2)}))
    if trained:
        trainer.train(1, frame_at())
    optimizer = trainer.optimizers[0]
    gone = [node.rows.near_logits, node.rows.far_logits, *mask.parameters()]
    parameters = sum(len(group["params"]) for group in optimizer.param_groups)
    end_mask(trainer, trainer.system, "background")
    held = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    assert len(held) == parameters - len(gone)
    assert all(group["params"] for group in optimizer.param_groups)
    for parameter in gone:
        assert all(parameter is not other for other in held)
        assert parameter not in optimizer.state
    assert not {"near_logits", "far_logits"} & node.rows.columns().keys()
    assert node.mask is not mask
    assert node.mask.columns == ()
