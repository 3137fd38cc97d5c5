"""What density control counts of the renderings of training, and when it starts anew."""

import pytest
import torch
from torch import Tensor

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.callbacks.density_control import resize_rows
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Rendering
from tests.training.callbacks.test_density_control import KEEPS_ALL, every_ten, started
from tests.training.stubs import (
    AskedStrategy,
    background,
    frame_at,
    no_gaussians,
)


def seen(system: StreetSystem, gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
    """Put a rendering with these row-wise answers where the system keeps its newest one."""
    offsets = torch.zeros_like(gradient, requires_grad=True)
    offsets.grad = gradient
    image, plane = torch.zeros(height, width, 3), torch.zeros(height, width)
    system.screen_gradients = True
    spans, start = {}, 0
    for name, count in system.scene.counts().items():
        spans[name] = slice(start, start + count)
        start += count
    system.rendering = SceneRendering(
        image, plane, plane, Rendering(image, plane, plane, radii, offsets), spans, {}, no_gaussians()
    )


def test_statistics_of_a_wide_image_by_hand():
    """|(g_x W/2, g_y H/2)| of each node's own rows; radii as fractions of the width."""
    control = every_ten()
    nodes = {
        "bare": background(2),
        "first": background(1, density=KEEPS_ALL),
        "second": background(2, density=KEEPS_ALL),
    }
    trainer, system, _ = started(control, **nodes)
    # Half image: 320 by 100 pixels.
    gradient = torch.tensor([[9.0, 9.0], [9.0, 9.0], [3 / 320, 4 / 100], [5 / 320, 12 / 100], [1.0, 1.0]])
    seen(system, gradient, torch.tensor([9.0, 9.0, 64.0, 32.0, 0.0]), 640, 200)
    control.on_after_backward(trainer, system)
    torch.testing.assert_close(control.statistics["first"].mean_gradients(), torch.tensor([5.0]))
    torch.testing.assert_close(control.statistics["second"].mean_gradients(), torch.tensor([13.0, 0.0]))
    assert control.statistics["first"].largest_screen.tolist() == pytest.approx([0.1])
    assert control.statistics["second"].largest_screen.tolist() == pytest.approx([0.05, 0.0])
    assert control.statistics["second"].visits.tolist() == [1, 0]


def test_statistics_are_those_of_the_renderings_of_the_steps():
    """Three real steps, the gradients read from what the system rendered, against a sum of our own."""
    control = every_ten()
    nodes = {"first": background(6, density=KEEPS_ALL), "second": background(9, seed=3, density=KEEPS_ALL)}
    trainer, system, _ = started(control, **nodes)
    sums, visits = torch.zeros(15), torch.zeros(15)
    for _ in range(3):
        trainer.train(1, frame_at(width=40, height=16))
        splats = system.rendering.splats
        sums += splats.screen_offsets.grad.mul(torch.tensor([20.0, 8.0])).square().sum(1).sqrt() * (splats.radii > 0)
        visits += splats.radii > 0
    assert float(sums.max()) > 0
    for name, rows in (("first", slice(0, 6)), ("second", slice(6, 15))):
        torch.testing.assert_close(control.statistics[name].gradient_sum, sums[rows])
        assert control.statistics[name].visits.tolist() == visits[rows].tolist()


def test_statistics_start_anew_after_a_refinement_and_only_then():
    strategy = AskedStrategy()
    control = every_ten(Interval(0.1, 0.1, every=10), pause=10)
    trainer, _, _ = started(control, background=background(4, density=strategy))
    trainer.global_step = 8
    trainer.train(2, frame_at())  # refined at 10, then reset; no refinement at 20
    assert strategy.asked[0]["statistics"].visits.max() == 2
    assert not control.statistics["background"].visits.any()
    assert not control.statistics["background"].gradient_sum.any()
    assert not control.statistics["background"].largest_screen.any()
    trainer.train(1, frame_at())
    trainer.global_step = 18
    trainer.train(2, frame_at())
    assert control.statistics["background"].visits.max() == 3
    trainer.global_step = 29
    trainer.train(1, frame_at())
    assert strategy.asked[-1]["statistics"].visits.max() == 4  # those of the pause as well


def test_statistics_follow_the_rows_whoever_changes_them():
    control = every_ten()
    nodes = {"first": background(4, density=KEEPS_ALL), "second": background(3, density=KEEPS_ALL)}
    trainer, system, _ = started(control, bare=background(2), **nodes)
    for row in range(4):
        control.statistics["first"].visits[row] = row
    keep = torch.tensor([False, True, False, True])
    resize_rows(trainer, system, "first", RowPlan.keep(keep), "somebody else")
    resize_rows(trainer, system, "bare", RowPlan.keep(torch.tensor([True, False])), "somebody else")
    assert control.statistics["first"].visits.tolist() == [1, 3]
    assert len(control.statistics["second"]) == 3
    trainer.walk(10)  # else the strategy would refuse them
    assert len(system.scene.nodes["first"].rows) == 2
