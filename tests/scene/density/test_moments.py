"""Optimizer moments follow their rows through densify, cull, opacity reset and pruning.

The oracle keeps each row as its own little object, with Adam written out, and knows nothing of row plans.
"""

import copy
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.gaussians import Rows
from tests.scene.density.scenes import make_rows, with_statistics
from tests.scene.street import static_mask

LEARNING_RATE, EPSILON = 0.01, 1e-15
RADIUS = 10.0


@dataclass
class SimulatedRow:
    """Values and moments of one Gaussian, by column, in float64."""

    values: dict[str, Tensor]
    first: dict[str, Tensor]
    second: dict[str, Tensor]
    instance: int

    def step(self, gradients: dict[str, Tensor], number: int) -> None:
        """Adam's update of this row (Kingma & Ba 2015, algorithm 1)."""
        for name, gradient in gradients.items():
            self.first[name] = 0.9 * self.first[name] + 0.1 * gradient
            self.second[name] = 0.999 * self.second[name] + 0.001 * gradient**2
            denominator = (self.second[name] / (1 - 0.999**number)).sqrt() + EPSILON
            self.values[name] = self.values[name] - LEARNING_RATE * self.first[name] / (1 - 0.9**number) / denominator

    def twin(self) -> "SimulatedRow":
        """A copy without history, but for how large the gradients of its mean were."""
        twin = copy.deepcopy(self)
        twin.first = {name: torch.zeros_like(moment) for name, moment in self.first.items()}
        twin.second = copy.deepcopy(twin.first) | {"means": twin.second["means"]}
        return twin


class Simulation:
    """The real rows under a real Adam beside the row-by-row oracle."""

    def __init__(self, number: int) -> None:
        self.generator = torch.Generator().manual_seed(3)
        self.rows: Rows = make_rows(number, self.generator)
        self.rows.double()
        groups = [{"params": [parameter], "name": name} for name, parameter in self.rows.named_parameters()]
        self.adam = torch.optim.Adam(groups, lr=LEARNING_RATE, eps=EPSILON)
        self.steps = 0
        columns = {name: parameter.detach() for name, parameter in self.rows.named_parameters()}
        self.simulated = [
            SimulatedRow(
                {name: column[row].clone() for name, column in columns.items()},
                {name: torch.zeros_like(column[row]) for name, column in columns.items()},
                {name: torch.zeros_like(column[row]) for name, column in columns.items()},
                int(self.rows.instances[row]),
            )
            for row in range(number)
        ]

    def train(self, steps: int) -> None:
        for _ in range(steps):
            self.steps += 1
            gradients = {}
            for name, parameter in self.rows.named_parameters():
                parameter.grad = torch.randn(parameter.shape, generator=self.generator, dtype=torch.float64)
                gradients[name] = parameter.grad
            self.adam.step()
            for index, row in enumerate(self.simulated):
                row.step({name: gradient[index] for name, gradient in gradients.items()}, self.steps)

    def check(self) -> None:
        assert len(self.rows) == len(self.simulated)
        assert self.rows.instances.tolist() == [row.instance for row in self.simulated]
        for name, parameter in self.rows.named_parameters():
            state = self.adam.state[parameter]
            for index, row in enumerate(self.simulated):
                # float64 round-off of a dozen steps
                torch.testing.assert_close(parameter.detach()[index], row.values[name], rtol=1e-12, atol=1e-12)
                torch.testing.assert_close(state["exp_avg"][index], row.first[name], rtol=1e-12, atol=1e-15)
                torch.testing.assert_close(state["exp_avg_sq"][index], row.second[name], rtol=1e-12, atol=1e-15)


def test_moments_through_densify_cull_reset_and_pruning():
    run = Simulation(7)
    run.train(4)
    run.check()

    # Densify: rows 2 (large) and 5 (small) are wanted; the parent of the split stays, shrunk, with its moments.
    for row, scale in ((2, 1.0), (5, 0.001)):
        with torch.no_grad():
            run.rows.log_scales[row] = torch.tensor(scale).log()
        run.simulated[row].values["log_scales"] = torch.full((3,), scale).log().double()
    statistics = with_statistics([0.0, 0.0, 0.01, 0.0, 0.0, 0.01, 0.0], screens=[0.0, 0.5, 0, 0, 0, 0, 0])
    plan = GradientDensity().densify(
        run.rows, statistics, radius=RADIUS, progress=0.5, max_gaussians=None, generator=run.generator
    )
    run.rows.resize(plan, run.adam)
    statistics.resize(plan)
    clone, children = run.simulated[5].twin(), [run.simulated[2].twin(), run.simulated[2].twin()]
    for row in (run.simulated[2], *children):
        row.values["log_scales"] = row.values["log_scales"] - torch.tensor(1.6, dtype=torch.float64).log()
    run.simulated += [clone, *children]
    for child, mean in zip(children, run.rows.means.detach()[-2:], strict=True):
        child.values["means"] = mean.clone()  # the only thing the oracle cannot know is where chance put them
    run.check()
    run.train(3)
    run.check()

    # Cull: row 1 was huge on screen, row 4 is faint; the oracle forgets both.
    with torch.no_grad():
        run.rows.opacity_logits[4] = -10.0
    density = GradientDensity(cull_scale_from=0.1, screen_size_until=0.5)
    run.rows.resize(density.cull(run.rows, statistics, radius=RADIUS, progress=0.5), run.adam)
    run.simulated = [row for index, row in enumerate(run.simulated) if index not in (1, 4)]
    run.check()
    run.train(2)

    # Opacity reset: values lowered, opacity moments gone, all other moments untouched.
    run.rows.resize(GradientDensity(reset_opacity_to=0.1).reset(run.rows), run.adam)
    limit = torch.logit(torch.tensor(0.1, dtype=torch.float64))
    for row in run.simulated:
        row.values["opacity_logits"] = torch.minimum(row.values["opacity_logits"], limit)
        row.first["opacity_logits"] = torch.zeros((), dtype=torch.float64)
        row.second["opacity_logits"] = torch.zeros((), dtype=torch.float64)
    run.check()
    run.train(2)

    # Pruning by mask: the two lowest go.
    scores = static_mask().scores(run.rows).detach()
    mask = static_mask(1, threshold=float(scores.sort().values[1]))
    run.rows.resize(mask.keep(run.rows).plan(), run.adam)
    lowest = sorted(run.simulated, key=lambda row: float(row.values["mask_logits"]))[:2]
    run.simulated = [row for row in run.simulated if all(row is not gone for gone in lowest)]
    run.check()
    run.train(3)
    run.check()
    assert len(run.adam.state) == sum(len(group["params"]) for group in run.adam.param_groups) == 7


@pytest.mark.parametrize(("steady", "rates"), [(True, 1.0), (False, 31.6)])
def test_how_far_one_gradient_throws_a_clone(steady, rates):
    """The steps after a gradient g are rate * 0.1 * 0.9^k g / sqrt(v), and sum up to rate * g / sqrt(v). The parent's v
    is g^2 if it has seen nothing else; without it v is 0.001 g^2."""
    rows = make_rows(1, torch.Generator().manual_seed(3))
    rows.log_scales.data.fill_(-9.0)  # small: cloned
    adam = torch.optim.Adam(rows.parameters(), lr=LEARNING_RATE, eps=EPSILON)

    def step(size: float) -> None:
        for parameter in rows.parameters():
            parameter.grad = torch.full_like(parameter, size)
        adam.step()

    step(1e-3)
    for state in adam.state.values():  # as after 10,000 such steps, when Adam corrects no bias any more
        state["step"].fill_(10_000)
        state["exp_avg_sq"].fill_(1e-6)
    plan = GradientDensity(steady_means=steady).grow(
        rows, torch.tensor([False]), torch.tensor([True]), torch.Generator()
    )
    rows.resize(plan, adam)
    before = rows.means.detach().clone()
    step(1e-3)
    for _ in range(60):  # not seen: 0.9^60 = 0.2 % of the way is left
        step(0.0)
    thrown = float((rows.means.detach() - before)[1].abs().max())
    # v decays by 0.1 % a step while the first moment dies away: 0.5 % of the way over its 10 steps.
    assert thrown == pytest.approx(rates * LEARNING_RATE, rel=0.02)
