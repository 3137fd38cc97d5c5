"""When nodes are refined and reset, which rows go, and what a resumed run knows of it."""

import copy
import logging

import pytest
import torch

from sparsestreet.ranks import Ranks
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_seed
from sparsestreet.scene.nodes import Node
from sparsestreet.training.callbacks import DensityControl, density_control
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem
from tests.training.stubs import (
    AskedStrategy,
    Listener,
    StubTrainer,
    background,
    frame_at,
    labels,
    make_system,
    rigid,
    set_rows,
)

NEVER = Interval(0.0, 0.0)
KEEPS_ALL = GradientDensity(grad_threshold=1e9, cull_opacity=0.0, cull_scale=1e9)


def every_ten(
    reset_in: Interval = NEVER, *, pause: int = 0, seed: int = 0, densify_until: float = 0.9
) -> DensityControl:
    """Refines at 10, 20 ... 90 of 100 steps."""
    return DensityControl(Interval(0.1, 0.9, every=10), densify_until, reset_in, pause_after_reset=pause, seed=seed)


def started(control: DensityControl, **nodes: Node) -> tuple[StubTrainer, StreetSystem, Listener]:
    listener = Listener()
    system = make_system(nodes)
    trainer = StubTrainer(system, [control, listener])
    trainer.start()
    return trainer, system, listener


def asked_at(strategy: AskedStrategy, what: str) -> list[int]:
    return [round(100 * given["progress"]) for given in strategy.asked if given["what"] == what]


def test_densify_until_its_fraction_and_cull_to_the_end_of_the_interval():
    strategy = AskedStrategy()
    trainer, _, _ = started(every_ten(densify_until=0.5), background=background(density=strategy))
    trainer.walk(100)
    assert asked_at(strategy, "densify") == [10, 20, 30, 40, 50]
    assert asked_at(strategy, "cull") == [10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert [given["what"] for given in strategy.asked[:4]] == ["densify", "cull", "densify", "cull"]


def test_screen_gradients_are_gathered_while_rows_are_refined_and_no_longer():
    trainer, system, _ = started(every_ten(), background=background(density=AskedStrategy()))
    wanted = []
    for step in range(100):
        trainer.walk(step + 1)
        wanted.append(system.screen_gradients)
    assert wanted == [True] * 90 + [False] * 10


def test_a_node_may_grow_for_another_time_than_the_others():
    never, early, late, others = (AskedStrategy() for _ in range(4))
    trainer, _, _ = started(
        every_ten(densify_until=0.5),
        never=background(density=never, densify_until=0.0),
        early=background(density=early, densify_until=0.2),
        late=background(density=late, densify_until=0.7),
        others=background(density=others),
    )
    trainer.walk(100)
    lasts = [asked_at(strategy, "densify")[-1] for strategy in (early, late, others)]
    assert lasts == [20, 70, 50]
    assert asked_at(never, "densify") == []
    assert asked_at(never, "cull")[-1] == asked_at(early, "cull")[-1] == 90
    with pytest.raises(ValueError, match=r"densify_until is a fraction of the run in \[0, 1\], got 2"):
        background(density=early, densify_until=2.0)


def test_a_reset_is_followed_by_a_pause():
    """Resets at 30 and 60, after the refinement that is due as well; none up to 20 steps later."""
    listener, strategy = Listener(), AskedStrategy()
    control = DensityControl(Interval(0.1, 0.9, every=10), 0.9, Interval(0.3, 0.6, every=30), pause_after_reset=20)
    system = make_system({"background": background(density=strategy)})
    trainer = StubTrainer(system, [control, listener])
    trainer.start()
    trainer.walk(100)
    assert asked_at(strategy, "cull") == asked_at(strategy, "densify") == [10, 20, 30, 60, 90]
    resets = [step for step, _, reason in listener.reasons if reason == "opacity reset"]
    assert resets == [30, 60]
    assert [reason for step, _, reason in listener.reasons if step == 30] == ["densify", "cull", "opacity reset"]


def test_the_strategy_is_told_radius_cap_and_the_callbacks_generator():
    strategy, control = AskedStrategy(), every_ten()
    node = background(density=strategy, max_gaussians=77)
    trainer, system, _ = started(control, background=node)
    trainer.walk(10)
    densify, cull = strategy.asked
    assert densify["generator"] is control.generator
    assert densify["max_gaussians"] == 77
    assert densify["radius"] == cull["radius"] == system.radius == 10.0


def test_every_node_has_its_own_strategy_and_one_without_keeps_its_rows():
    first, second = AskedStrategy(), AskedStrategy()
    nodes = {"near": background(3, density=first), "far": background(5, density=second), "rest": background(7)}
    control = every_ten()
    trainer, _, listener = started(control, **nodes)
    trainer.walk(10)
    assert [len(strategy.asked[0]["statistics"]) for strategy in (first, second)] == [3, 5]
    assert {node for _, node, _ in listener.reasons} == {"near", "far"}
    assert set(control.statistics) == {"near", "far"}


def test_oversized_rows_go_after_their_fraction_and_not_before():
    """cull_scale 0.2 of a radius of 10 m: rows 3 and 7 are larger than 2 m, row 5 is not."""
    node = background(10, density=GradientDensity(grad_threshold=1e9, cull_scale=0.2, cull_scale_from=0.3))
    set_rows(node, "opacity_logits", dict.fromkeys(range(10), 0.0))
    set_rows(node, "log_scales", {3: 1.0, 5: 0.6, 7: 3.0})  # 2.7 m, 1.8 m, 20 m
    trainer, _, listener = started(every_ten(), background=node)
    trainer.walk(30)
    assert labels(node) == list(range(10))
    trainer.walk(40)
    assert labels(node) == [0, 1, 2, 4, 5, 6, 8, 9]
    assert [(step, reason) for step, _, reason in listener.reasons][-2:] == [(40, "densify"), (40, "cull")]


def test_rows_outside_their_box_go_after_the_cull():
    """Boxes of 4 x 2 x 1.5 m (even rows) and 1 x 1 x 2 m (odd ones), with 0.1 m of margin."""
    node = rigid(8, density=KEEPS_ALL)
    places = [
        [2.05, 0, 0],
        [0.55, 0, 0],
        [0, 1.15, 0],
        [0.65, 0, 0],
        [1, 0.9, -0.8],
        [0, 0, -1.2],
        [0, 0, 0.9],
        [0.5, 0, 1],
    ]
    with torch.no_grad():
        node.rows.means.copy_(torch.tensor(places))
    control = every_ten()
    trainer, system, listener = started(control, rigid=node, background=background(5, density=KEEPS_ALL))
    trainer.walk(10)
    assert labels(node) == [0, 1, 4, 7]
    assert node.rows.instances.tolist() == [0, 1, 0, 1]
    assert len(control.statistics["rigid"]) == 4
    assert [reason for _, name, reason in listener.reasons if name == "rigid"] == ["densify", "cull", "outside its box"]
    assert len(system.scene.nodes["background"].rows) == 5
    trainer.walk(20)  # nothing is outside any more: nobody is told of a change
    assert [reason for step, name, reason in listener.reasons if (step, name) == (20, "rigid")] == ["densify", "cull"]


def test_a_reset_lowers_opacities_and_forgets_their_moments_only():
    node = background(6, density=KEEPS_ALL)
    trainer, _, _ = started(every_ten(Interval(0.05, 0.05, every=5)), background=node)
    trainer.train(4, frame_at())
    before = node.rows.opacity_logits.detach().clone()
    optimizer = trainer.optimizers[0]
    assert optimizer.state[node.rows.opacity_logits]["exp_avg"].any()
    trainer.walk(5)
    # Whoever looks at the scene behind step 5, as validation does, still sees it with its opacities.
    assert torch.equal(node.rows.opacity_logits, before)
    trainer.walk(6)
    limit = torch.logit(torch.tensor(0.01))
    torch.testing.assert_close(node.rows.opacity_logits.detach(), before.clamp(max=limit))
    assert bool((node.rows.opacity_logits < before).all())
    for moment in ("exp_avg", "exp_avg_sq"):
        assert not optimizer.state[node.rows.opacity_logits][moment].any()
        assert optimizer.state[node.rows.means][moment].any()


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


@pytest.mark.parametrize("densify_until", [0.05, 0.95])
def test_densification_outside_the_refinement_is_refused(densify_until):
    with pytest.raises(ValueError, match="densify_until must lie between"):
        every_ten(densify_until=densify_until)


class Shaking(AskedStrategy):
    """Moves every mean by the rate, and by a number that follows from the seed."""

    def noise(self, rows: Rows, rate: float, seed: int) -> torch.Tensor:
        return torch.full_like(rows.means, rate + (seed % 1000))


def test_noise_is_added_after_every_step_and_follows_from_the_step():
    """Whether a run was interrupted or not, and to the nodes alone whose strategy asks for it."""
    means = {}
    for resumed in (False, True):
        node, still = background(3, density=Shaking()), background(3, density=AskedStrategy())
        trainer, _, _ = started(every_ten(seed=5), near=node, far=still)
        start, before = node.rows.means.detach().clone(), still.rows.means.detach().clone()
        if resumed:
            trainer.global_step = 2
        trainer.walk(3)
        means[resumed] = node.rows.means.detach() - start
        assert torch.equal(still.rows.means, before)
        assert node.rows.means.grad is None
    rate = 0.01  # that of the rows
    added = [rate + named_seed(5, f"noise near {step}") % 1000 for step in (1, 2, 3)]
    # Sums of float32 numbers up to a thousand.
    torch.testing.assert_close(means[False], torch.full((3, 3), sum(added)), rtol=1e-6, atol=1e-3)
    torch.testing.assert_close(means[True], torch.full((3, 3), added[2]), rtol=1e-6, atol=1e-3)


def drivestudio(every: int = 30) -> DensityControl:
    """Resets at 32, 62 and 92, if every 30 steps; refines at 5, 10 ... 100 of 100 steps."""
    return DensityControl(
        Interval(0.0, 1.0, every=5), 1.0, Interval(0.0, 1.0, every=every, shift=2), pause_after_reset=None
    )


def test_after_a_reset_every_training_image_comes_first():
    """DriveStudio's gate: 12 images close the first 12 steps of each 30; nothing is reset at step 2."""
    strategy, listener = AskedStrategy(), Listener()
    system = make_system({"background": background(4, density=strategy)})
    trainer = StubTrainer(system, [control := drivestudio(), listener], train=tuple(map(frame_at, range(12))))
    trainer.start()
    trainer.walk(10)
    control.statistics["background"].visits += 1
    trainer.walk(15)
    trainer.walk(100)
    assert asked_at(strategy, "cull") == [15, 20, 25, 45, 50, 55, 75, 80, 85]
    assert [step for step, _, reason in listener.reasons if reason == "opacity reset"] == [32, 62, 92]
    # What falls out forgets what was seen since, as a refinement does.
    control.statistics["background"].visits += 1
    trainer.walk(101)
    assert control.statistics["background"].visits.tolist() == [1] * 4
    trainer.global_step = 94
    trainer.walk(95)
    assert control.statistics["background"].visits.tolist() == [0] * 4


def test_few_images_close_as_many_steps_as_lie_between_two_refinements():
    strategy = AskedStrategy()
    trainer, _, _ = started(drivestudio(), background=background(4, density=strategy))
    trainer.walk(45)
    assert asked_at(strategy, "cull") == [10, 15, 20, 25, 30 + 10, 30 + 15]


def test_images_that_leave_no_time_to_refine_are_refused():
    system = make_system({"background": background(4, density=AskedStrategy())})
    trainer = StubTrainer(system, [drivestudio(every=10)], train=tuple(map(frame_at, range(12))))
    with pytest.raises(ValueError, match="the 12 training images fill the 10 steps between two opacity resets"):
        trainer.start()


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


GROWS_ALL = GradientDensity(grad_threshold=1e-12, cull_opacity=0.0, cull_scale=1e9)


def grown(monkeypatch: pytest.MonkeyPatch, *free: float) -> tuple[DensityControl, StreetSystem, Listener]:
    """Two refinements of 20 rows that all want to grow, where memory says it has ``free`` bytes."""
    said = iter(free)
    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: next(said))
    control = every_ten()
    trainer, system, listener = started(control, background=background(20, density=GROWS_ALL))
    for _ in free:
        statistics = control.statistics["background"]
        statistics.gradient_sum += 1 + torch.arange(len(statistics))
        statistics.visits += 1
        trainer.walk(trainer.global_step + 10)
    return control, system, listener


def rows_after(listener: Listener) -> list[int]:
    return [change.after for change, _ in listener.heard if change.reason == "densify"]


def test_memory_holds_growth_back_which_is_said_once(monkeypatch, caplog):
    """20 rows of 59 numbers and a label of 8 bytes each would be 60."""
    each = 4 * (59 * 4 + 8) + 350
    with caplog.at_level(logging.WARNING):
        _, system, listener = grown(monkeypatch, 6 * each, 0.5 * each)
    first, second = rows_after(listener)
    assert 20 < first <= 26
    assert second == first
    assert system.held_back == {"background": 40 - 6 + 2 * first}
    (said,) = [record.message for record in caplog.records if "memory" in record.message]
    assert said.startswith(f"step 10: 'background' would grow by 40 Gaussians of {each:,} bytes each, and memory has")
    assert " room for 6: no more are added." in said


def test_where_memory_has_room_nothing_changes(monkeypatch):
    """Not even the draws: rows are those of a run that is not asked."""
    ends = []
    for free in (float("inf"), 40 * (4 * (59 * 4 + 8) + 350.0)):
        _, system, _ = grown(monkeypatch, free)
        assert system.held_back == {}
        ends.append(system.scene.nodes["background"].rows)
    assert torch.equal(ends[0].means, ends[1].means)
    assert len(ends[0]) == 60


def test_what_fits_is_what_a_limit_would_allow(monkeypatch):
    """A plan that is made again draws the same numbers."""
    _, system, _ = grown(monkeypatch, 6 * (4 * (59 * 4 + 8) + 350.0))
    strategy = GROWS_ALL
    limited = every_ten()
    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: float("inf"))
    trainer, other, _ = started(limited, background=background(20, density=strategy, max_gaussians=26))
    limited.statistics["background"].gradient_sum += 1 + torch.arange(20)
    limited.statistics["background"].visits += 1
    trainer.walk(10)
    assert torch.equal(system.scene.nodes["background"].rows.means, other.scene.nodes["background"].rows.means)


def test_several_processes_add_what_the_fullest_has_room_for(monkeypatch):
    """The largest of the negated rooms, as all of them hear it."""
    heard = []

    class Fuller(Ranks):
        def largest(self, values):
            if values.dim() == 0:
                heard.append(float(values))
                return torch.maximum(values, torch.tensor(-3 * (4 * (59 * 4 + 8) + 350.0), dtype=torch.float64))
            return values

        def sum(self, values):
            return values

    monkeypatch.setattr(density_control, "bytes_for_growth", lambda device: 1e9)
    control = every_ten()
    trainer, system, _ = started(control, background=background(20, density=GROWS_ALL))
    control._ranks = Fuller(0, 2)
    assert control._fits(trainer, system, "background", 40) == 23
    assert heard == [-1e9]
