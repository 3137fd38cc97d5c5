"""What a resumed run knows of density control: statistics, chance, pauses, and those of several processes."""

import copy

import pytest
import torch

from sparsestreet.ranks import Ranks
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.nodes import Node
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.schedule import Interval
from tests.training.callbacks.refining import asked_at, every_ten, started
from tests.training.stubs import AskedStrategy, StubTrainer, background, frame_at, make_system

KEEPS_ALL = GradientDensity(grad_threshold=1e9, cull_opacity=0.0, cull_scale=1e9)


def splitting(count: int = 20) -> Node:
    """Rows of which all that have been seen are split or cloned: a refinement asks chance."""
    return background(count, density=GradientDensity(grad_threshold=0.0, split_scale=0.01, cull_opacity=0.0))


def test_seeds_decide_where_children_lie():
    means = []
    for seed in (1, 1, 2):
        node = splitting()
        trainer, _, _ = started(every_ten(seed=seed), background=node)
        trainer.global_step = 9
        trainer.train(1, frame_at())
        means.append(node.rows.means.detach())
    assert len(means[0]) > 20
    assert torch.equal(means[0], means[1])
    assert not torch.equal(means[0], means[2])


def test_a_resumed_run_goes_on_as_the_uninterrupted_one(tmp_path):
    """Statistics, the generator and the pause after a reset come back: cut after 24 of 30 steps, inside a pause."""
    resets = Interval(0.1, 0.2, every=10)
    control, node = every_ten(resets, pause=9), splitting()
    trainer, _, _ = started(control, background=node)
    trainer.global_step = 9
    trainer.train(1, frame_at())
    trainer.global_step = 18
    trainer.train(6, frame_at())
    torch.save(control.state_dict(), tmp_path / "control.pt")
    resumed_node, step = copy.deepcopy(node), trainer.global_step
    optimizer_state = copy.deepcopy(trainer.optimizers[0].state_dict())
    trainer.train(6, frame_at())

    resumed = every_ten(resets, pause=9, seed=5)
    later = StubTrainer(make_system({"background": resumed_node}), [resumed])
    resumed.load_state_dict(torch.load(tmp_path / "control.pt", weights_only=True))
    later.optimizers[0].load_state_dict(optimizer_state)
    later.global_step = step
    later.start()
    later.train(6, frame_at())
    assert len(node.rows) > 40
    for name, column in node.rows.columns().items():
        assert torch.equal(resumed_node.rows.columns()[name], column), name


def test_a_pause_outlives_a_resume():
    resets = Interval(0.3, 0.3, every=10)
    trainer, _, _ = started(control := every_ten(resets, pause=20), background=background(4, density=AskedStrategy()))
    trainer.walk(34)
    strategy = AskedStrategy()
    resumed = every_ten(resets, pause=20)
    later = StubTrainer(make_system({"background": background(4, density=strategy)}), [resumed])
    resumed.load_state_dict(control.state_dict())
    later.global_step = 34
    later.start()
    later.walk(70)
    assert asked_at(strategy, "cull") == [60, 70]


def test_a_state_has_the_number_of_rows_of_its_moment():
    """A checkpoint comes from after a growth: setup, which saw the rows before, does not count."""
    control = every_ten()
    started(control, background=background(4, density=KEEPS_ALL))
    resumed = every_ten()
    started(resumed, background=background(9, density=KEEPS_ALL))
    resumed.load_state_dict(control.state_dict())
    assert len(resumed.statistics["background"]) == 4


class Together(Ranks):
    """One of two processes, of which the other says what it is told."""

    def gathered(self, value):
        return [value, {name: state | {"visits": state["visits"] + 5} for name, state in value.items()}]


def resumed_by(rank: int, size: int) -> DensityControl:
    """After a checkpoint of two processes: the first has seen its rows once, the other five times more."""
    before = every_ten()
    StubTrainer(make_system({"background": background(3, density=AskedStrategy())}), [before])
    before.statistics["background"].visits += 1
    before._ranks = Together(0, 2)
    after = every_ten()
    after.load_state_dict(copy.deepcopy(before.state_dict()))
    after._take_own(Ranks(rank, size))
    return after


@pytest.mark.parametrize(("rank", "size", "visits"), [(0, 2, 1), (1, 2, 6), (0, 1, 7), (0, 3, 7), (2, 3, 0)])
def test_processes_go_on_with_their_own_statistics_and_another_number_of_them_with_all(rank, size, visits):
    statistics = resumed_by(rank, size).statistics["background"]
    assert statistics.visits.tolist() == [visits] * 3
