"""Adam of what a step has seen: rows by their gradient, row surgery, checkpoints, closures, the configuration."""

import copy
from dataclasses import replace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor, nn

from sparsestreet.cli.config.compose import CONF
from sparsestreet.ops import splat
from sparsestreet.scene.gaussians import RowPlan, Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.training.adam import RowAdam, VisibleAdam, seen_rows
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.types import Gaussians
from tests.ops.scenes import camera, cast, random_gaussians
from tests.training.stubs import background
from tests.typed import there

LR = 0.01


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def scene(number: int = 9) -> SceneGraph:
    """Masked rows in float64."""
    rates = {"rows": LearningRate(LR)}
    return SceneGraph({"background": background(number, mask=StaticMaskSettings(1.0), learning_rates=rates)}).double()


def table() -> tuple[Rows, torch.optim.Optimizer]:
    """Its rows under the optimizer that the configuration chooses."""
    street = scene()
    return street.nodes["background"].rows, OptimizerSettings(visible_only=True).build(street, 1.0)


def give_gradients(rows: nn.Module, seen: Tensor, generator: torch.Generator) -> None:
    for parameter in rows.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        parameter.grad[~seen] = 0


class OneRow:
    """Adam of one row of one column, written out (Kingma & Ba 2015, algorithm 1)."""

    def __init__(self, value: Tensor) -> None:
        self.value, self.first, self.second = value.clone(), torch.zeros_like(value), torch.zeros_like(value)

    def step(self, gradient: Tensor, count: int) -> None:
        if bool((gradient == 0).all()):
            return
        self.first = 0.9 * self.first + 0.1 * gradient
        self.second = 0.999 * self.second + 0.001 * gradient**2
        root = (self.second / (1 - 0.999**count)).sqrt() + 1e-15
        self.value = self.value - LR * self.first / (1 - 0.9**count) / root


def test_moments_follow_their_rows_through_a_plan(generator):
    rows, optimizer = table()
    simulated = {name: [OneRow(value) for value in column.detach()] for name, column in rows.named_parameters()}
    plan = RowPlan(9, torch.tensor([8, 1, 1, 4, 2]), torch.tensor([False, False, True, False, False]))
    for count in range(1, 7):
        if count == 4:
            rows.resize(plan, optimizer)
            for name, column in simulated.items():
                simulated[name] = [copy.deepcopy(column[source]) for source in plan.source.tolist()]
                simulated[name][2].first.zero_()
                simulated[name][2].second.zero_()
        give_gradients(rows, torch.rand(len(rows), generator=generator) < 0.5, generator)
        optimizer.step()
        for name, parameter in rows.named_parameters():
            for row, gradient in zip(simulated[name], there(parameter.grad), strict=True):
                row.step(gradient, count)
    for name, parameter in rows.named_parameters():
        state = optimizer.state[parameter]
        kept = {"value": parameter.detach(), "first": state["exp_avg"], "second": state["exp_avg_sq"]}
        for field, column in kept.items():
            expected = torch.stack([getattr(row, field) for row in simulated[name]])
            # float64 round-off of six steps
            torch.testing.assert_close(column, expected, rtol=1e-12, atol=1e-15)


def test_rows_without_gradient_keep_every_bit(generator):
    rows, optimizer = table()
    give_gradients(rows, torch.ones(9, dtype=torch.bool), generator)
    optimizer.step()
    seen = torch.arange(9) % 2 == 0
    before = {name: parameter.detach().clone() for name, parameter in rows.named_parameters()}
    moments = {name: optimizer.state[parameter]["exp_avg"].clone() for name, parameter in rows.named_parameters()}
    give_gradients(rows, seen, generator)
    rows.mask_logits.grad.fill_(1e-9)  # a regularizer of every mask
    optimizer.step()
    for name, parameter in rows.named_parameters():
        stepped = torch.ones(9, dtype=torch.bool) if name == "mask_logits" else seen
        moved = (parameter.detach() != before[name]).reshape(9, -1).any(1)
        felt = (optimizer.state[parameter]["exp_avg"] != moments[name]).reshape(9, -1).any(1)
        assert torch.equal(moved, stepped), name
        assert torch.equal(felt, stepped), name


def test_what_counts_as_seen():
    gradient = torch.zeros(5, 2, 3)
    gradient[1, 1, 2] = 1e-45  # the smallest number above zero
    gradient[2, 0, 0] = -1.0
    gradient[3, 1, 0] = torch.nan
    gradient[4] = -0.0
    assert seen_rows(gradient).tolist() == [False, True, True, True, False]
    assert seen_rows(torch.tensor([0.0, 2.0])).tolist() == [False, True]
    assert seen_rows(torch.zeros(0, 3)).tolist() == []
    assert seen_rows(torch.zeros(2, 0)).tolist() == [False, False]


def test_the_op_says_what_a_view_has_seen():
    """No gradient of a row that was not drawn, in any field, is other than zero; rows in the image have one."""
    view = camera(24, 16)
    shown = random_gaussians(12, view)
    behind = replace(shown, means=shown.means - 100 * view.camera_from_world[2, :3])
    leaves = cast(Gaussians.concatenate([shown, behind]), torch.float32, requires_grad=True)
    rendering = splat(leaves, view)
    (rendering.rgb.square().sum() + rendering.alpha.sum()).backward()
    for field in (leaves.means, leaves.quaternions, leaves.scales, leaves.opacities, leaves.dense_sh()):
        seen = seen_rows(there(field.grad))
        assert 6 <= int(seen.sum()) <= 12
        assert not bool((seen & ~rendering.visible).any())


def test_it_goes_on_from_its_own_checkpoint_and_from_adams(generator):
    """With gradients everywhere all three take the same path."""
    ends = []
    for first, second in (("adam", "adam"), ("adam", "visible"), ("visible", "visible")):
        generator.manual_seed(4)
        street = scene(5)
        rows = street.nodes["background"].rows
        kinds = {kind: OptimizerSettings(visible_only=kind == "visible") for kind in ("adam", "visible")}
        state = None
        for kind in (first, second):
            optimizer = kinds[kind].build(street, 1.0)
            if state is not None:
                optimizer.load_state_dict(state)
            for _ in range(3):
                give_gradients(rows, torch.ones(5, dtype=torch.bool), generator)
                optimizer.step()
            state = copy.deepcopy(optimizer.state_dict())
        ends.append(torch.cat([parameter.detach().flatten() for parameter in rows.parameters()]))
    for end in ends[1:]:
        torch.testing.assert_close(end, ends[0], rtol=1e-12, atol=1e-15)


def test_a_closure_computes_gradients_and_parameters_without_any_rest(generator):
    used, unused = (nn.Parameter(torch.randn(3, 2, generator=generator)) for _ in range(2))
    optimizer = VisibleAdam([used, unused], lr=LR)
    before = unused.detach().clone()

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = used.square().sum()
        loss.backward()
        return loss

    losses = [optimizer.step(closure).item() for _ in range(3)]
    assert losses == sorted(losses, reverse=True)
    assert torch.equal(unused, before)
    assert unused not in optimizer.state


@pytest.mark.lengthy
@pytest.mark.parametrize(("visible_only", "kind"), [("false", RowAdam), ("true", VisibleAdam)])
def test_the_configuration_chooses(visible_only, kind):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        chosen = compose("train", [f"optimizer.visible_only={visible_only}"]).optimizer
        default = compose("train").optimizer
    optimizer = instantiate(chosen, _convert_="all").build(scene(2), 1.0)
    assert type(optimizer) is kind
    assert optimizer.defaults["eps"] == 1e-15
    assert (chosen == default) == (visible_only == "false")
