"""When nodes are refined and reset, and which rows go."""

import pytest
import torch

from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_seed
from sparsestreet.training.callbacks import DensityControl
from sparsestreet.training.schedule import Interval
from tests.training.callbacks.refining import asked_at, every_ten, started
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

KEEPS_ALL = GradientDensity(grad_threshold=1e9, cull_opacity=0.0, cull_scale=1e9)


def test_densify_until_its_fraction_and_cull_to_the_end_of_the_interval():
    strategy = AskedStrategy()
    trainer, _, _ = started(every_ten(densify_until=0.5), background=background(density=strategy))
    trainer.walk(100)
    assert asked_at(strategy, "densify") == [10, 20, 30, 40, 50]
    assert asked_at(strategy, "cull") == [10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert [given["what"] for given in strategy.asked[:4]] == ["densify", "cull", "densify", "cull"]


@pytest.mark.parametrize(
    ("rises", "expected"),
    [
        # Of 81 rows that may come by step 50, those of each refinement by hand: 16.2, 32.4, 48.6, 64.8, 81.
        (True, {"near": [36, 52, 68, 84, 101], "early": [60, 101], "full": [25] * 5, "free": [None] * 5}),
        (False, {"near": [101] * 5, "early": [101] * 2, "full": [25] * 5, "free": [None] * 5}),
    ],
)
def test_a_limit_rises_from_the_first_rows_to_its_full_height_where_a_node_stops_growing(rises, expected):
    strategies = {name: AskedStrategy() for name in expected}
    trainer, _, _ = started(
        every_ten(densify_until=0.5),
        near=background(20, density=strategies["near"], max_gaussians=101, limit_rises=rises),
        early=background(20, density=strategies["early"], max_gaussians=101, limit_rises=rises, densify_until=0.2),
        full=background(30, density=strategies["full"], max_gaussians=25, limit_rises=rises),
        free=background(20, density=strategies["free"], max_gaussians=None, limit_rises=rises),
    )
    trainer.walk(100)
    assert {name: limits(strategy) for name, strategy in strategies.items()} == expected


def test_a_resumed_limit_rises_from_the_rows_at_the_start_of_the_training():
    before, after = every_ten(densify_until=0.5), every_ten(densify_until=0.5)
    started(before, near=background(20, density=AskedStrategy(), max_gaussians=101, limit_rises=True))[0].walk(20)
    # The rows have grown meanwhile.
    strategy = AskedStrategy()
    trainer, _, _ = started(after, near=background(70, density=strategy, max_gaussians=101, limit_rises=True))
    after.load_state_dict(before.state_dict() | {"statistics": after.state_dict()["statistics"]})
    trainer.global_step = 20
    trainer.walk(100)
    assert limits(strategy) == [68, 84, 101]


def limits(strategy: AskedStrategy) -> list[int | None]:
    return [given["max_gaussians"] for given in strategy.asked if given["what"] == "densify"]


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
    strategy = AskedStrategy()
    trainer, _, listener = started(
        every_ten(Interval(0.3, 0.6, every=30), pause=20), background=background(density=strategy)
    )
    trainer.walk(100)
    assert asked_at(strategy, "cull") == asked_at(strategy, "densify") == [10, 20, 30, 60, 90]
    resets = [step for step, _, reason in listener.reasons if reason == "opacity reset"]
    assert resets == [30, 60]
    assert [reason for step, _, reason in listener.reasons if step == 30] == ["densify", "cull", "opacity reset"]


def test_a_pause_counts_images():
    """Two a step: a reset after step 15, and 20 images later it is step 25."""
    strategy = AskedStrategy()
    control = DensityControl(Interval(0.0, 0.4, every=10), 0.4, Interval(0.1, 0.2, every=30), pause_after_reset=20)
    trainer, system, _ = started(control, background=background(density=strategy))
    system.course.images_per_step = 2
    trainer.walk(100)
    assert asked_at(strategy, "cull") == [5, 10, 15, 30, 35, 40]


def test_the_strategy_is_told_radius_cap_and_the_callbacks_generator():
    strategy, control = AskedStrategy(), every_ten()
    node = background(density=strategy, max_gaussians=77, limit_rises=False)
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
    assert sorted(labels(node)) == list(range(10))
    trainer.walk(40)
    assert sorted(labels(node)) == [0, 1, 2, 4, 5, 6, 8, 9]
    assert [(step, reason) for step, _, reason in listener.reasons][-2:] == [(40, "densify"), (40, "cull")]


def test_rows_of_what_stands_still_lie_along_a_curve():
    """The corners of a cube: bits of x, y and z, by turns. Rows of objects stay where they are."""
    node, cars = background(8, density=KEEPS_ALL), rigid(8, density=KEEPS_ALL)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    mixed = torch.randperm(8, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        node.rows.means.copy_(corners[mixed])
        cars.rows.means.copy_(0.4 * corners[mixed])
    trainer, _, _ = started(every_ten(), background=node, rigid=cars)
    trainer.walk(10)
    steps = node.rows.means.diff(dim=0).abs().sum(1)
    # A curve of Morton through eight corners has four steps along an axis, two along two and one along all three.
    assert sorted(steps.tolist()) == [1, 1, 1, 1, 2, 2, 3]
    assert labels(cars) == list(range(8))
    assert sorted(labels(node)) == list(range(8))


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
        Interval(0.05, 1.0, every=5), 1.0, Interval(0.05, 1.0, every=every, shift=2), pause_after_reset=None
    )


def test_after_a_reset_every_training_image_comes_first():
    """DriveStudio's gate: 12 images close the first 12 steps of each 30; none is reset at step 2, before it begins."""
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
