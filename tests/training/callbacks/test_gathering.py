"""What training steps find out for a pass of removal, so that it renders nothing: against the pass that renders."""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from sparsestreet.data.lazy import as_frames
from sparsestreet.pruning import Gathered, LeaveOneOutRule, RenderContext, rules
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.gaussians import RowPlan, Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import SampledMaskSettings
from sparsestreet.training.callbacks import Checkpoints, Pruning
from sparsestreet.training.callbacks.density_control import resize_rows
from sparsestreet.training.run import CPU_TRAINER, fit
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Frame
from tests.scene.street import POSE_RATES, RATES
from tests.training.stubs import background, make_system, rigid, street_data

IMAGES = 7
TRAINER = partial(CPU_TRAINER, limit_val_batches=0)
STILL = dict.fromkeys(RATES | POSE_RATES | {"texels": 0}, LearningRate(1e-12))
"""Nothing moves, so that what was seen in a step still holds at the pass."""


class Both(LeaveOneOutRule):
    """Scores as it would, with what was gathered and without, and removes nothing."""

    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        assert context.gathered is not None
        rest = context.gathered.rest(as_frames(frames), context.ranks)
        for views, seen in ((frames, Gathered(scene, self.areas(scene))), (rest, context.gathered)):
            costs = self.costs(scene, views, context, seen)
            self.found.append((costs, seen.areas.floors()))
        self.rests.append(len(rest))
        return {}

    found: list
    rests: list


def both() -> Both:
    rule = Both(allowed_db=0.1, noticeable=0.0)
    object.__setattr__(rule, "found", [])
    object.__setattr__(rule, "rests", [])
    return rule


class Change(Callback):
    """Changes the rows of the road after a step: what ``plan`` makes of their number."""

    def __init__(self, step: int, keep: list[int], fresh: bool = False) -> None:
        self.step, self.keep, self.fresh = step, torch.tensor(keep), fresh

    def on_train_batch_end(self, trainer: Trainer, pl_module: StreetSystem, *rest: object) -> None:
        if trainer.global_step == self.step:
            plan = RowPlan(
                len(pl_module.scene.nodes["road"].rows), self.keep, torch.full_like(self.keep, self.fresh).bool()
            )
            resize_rows(trainer, pl_module, "road", plan, "test")


def train(
    folder: Path, rule: LeaveOneOutRule, *others: Callback, start: Path | None = None, steps: int = 20, **road: Any
) -> StreetSystem:
    """Of 20 steps over seven images, with a pass after 18, that is four steps into the third epoch."""
    road.setdefault("learning_rates", STILL)
    nodes = {
        "road": background(30, **road),
        "cars": rigid(20, learning_rates=STILL, min_instance_gaussians=600.0),
    }
    sky = Sky(SkySettings(resolution=2, learning_rates={"texels": LearningRate(1e-12)}))
    system = make_system(nodes, effects={"sky": sky})
    fit(
        system,
        street_data(IMAGES, stride=0),
        [Pruning([0.9], rule), *others],
        TRAINER,
        folder,
        max_steps=steps,
        start=start,
    )
    return system


def check(rule: Both) -> None:
    (costs, floors), (gathered, same) = rule.found
    for name, cost in costs.items():
        # float32 images; the light behind a splat is summed from the other side.
        torch.testing.assert_close(gathered[name], cost, rtol=2e-3, atol=1e-7 * float(cost.max()))
    assert float(costs["road"].max()) > 0
    assert torch.equal(same["cars"].instances.least, floors["cars"].instances.least)
    assert int(floors["cars"].instances.least.sum()) > 2


def test_steps_say_what_the_pass_would_see(tmp_path):
    rule = both()
    train(tmp_path, rule)
    assert rule.rests == [0]
    check(rule)


def test_the_pass_renders_nothing(tmp_path, monkeypatch, caplog):
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("a pass rendered a view that a step has shown")

    for name in ("render", "leave_one_out"):
        monkeypatch.setattr(rules, name, refuse)
    with caplog.at_level(logging.INFO):
        system = train(tmp_path, LeaveOneOutRule(0.0, keep={"road": 12}), learning_rates=RATES)
    assert len(system.scene.nodes["road"].rows) == 12
    assert not any("looks at" in line for line in caplog.messages)


def test_sums_follow_rows_that_stay(tmp_path):
    rule = both()
    train(tmp_path, rule, Change(15, [2, 3, 5, *range(8, 30)]))
    assert rule.rests == [0]
    (costs, _), (gathered, _) = rule.found
    assert len(gathered["road"]) == len(costs["road"]) == 25
    # What went was seen as well, in front of some and behind others: only the last three views do not know it.
    ranks = [each["road"].argsort().argsort().double() for each in (costs, gathered)]
    assert float(torch.corrcoef(torch.stack(ranks))[0, 1]) > 0.9


@pytest.mark.parametrize("step", [15, 17])
def test_where_rows_come_the_pass_looks_at_what_was_seen_before(tmp_path, caplog, step):
    rule = both()
    with caplog.at_level(logging.INFO):
        train(tmp_path, rule, Change(step, [*range(30), 4], fresh=True))
    assert rule.rests == [IMAGES - (18 - step)]
    assert sum(f"looks at {rule.rests[0]} of {IMAGES} views" in line for line in caplog.messages) == 1
    check(rule)


def test_steps_that_can_say_nothing_leave_all_to_the_pass(tmp_path):
    """Rows that a sample hides, a view beside the path, small images."""
    sampled = both()
    train(tmp_path / "sampled", sampled, mask=SampledMaskSettings(sparsity_weight=0.0))
    assert sampled.rests == [IMAGES]
    assert not LeaveOneOutRule(0.1, beside=1.0).gathers


def test_a_resumed_run_knows_what_was_seen(tmp_path):
    whole, resumed = both(), both()
    train(tmp_path / "whole", whole, Checkpoints(tmp_path / "whole" / "checkpoints", 1000, [0.8]))
    (saved,) = (tmp_path / "whole" / "checkpoints").glob("before*")
    train(tmp_path / "resumed", resumed, start=saved)
    assert resumed.rests == [0]
    for name, costs in whole.found[1][0].items():
        assert torch.equal(resumed.found[1][0][name], costs)
