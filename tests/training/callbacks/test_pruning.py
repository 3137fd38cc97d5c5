"""When the rule is asked, with which frames and how it is to look; what becomes of its answer."""

import logging
from collections.abc import Sequence

import torch

from sparsestreet.ops import SplatSettings
from sparsestreet.pruning import ImportanceRule, PruningRule, RenderContext
from sparsestreet.scene.gaussians import Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.state import SceneState
from sparsestreet.training.callbacks import Pruning
from sparsestreet.types import Frame
from tests.training.stubs import (
    Listener,
    StubTrainer,
    background,
    frame_at,
    labels,
    make_system,
    rigid,
    set_rows,
    street_data,
)


class AskedRule(PruningRule):
    """Writes down what it is asked, and answers what it was told to."""

    def __init__(self, answer: dict[str, Selection] | None = None) -> None:
        self.asked: list[tuple[SceneGraph, Sequence[Frame], RenderContext]] = []
        self.answer = answer or {}

    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        self.asked.append((scene, frames, context))
        return self.answer


DATA = street_data(7, stride=3, offset=1)
"""Instants 1 and 4 are held out."""


def test_the_rule_is_asked_once_at_each_milestone_with_the_training_frames_and_todays_look():
    rule = AskedRule()
    options = RenderOptions(SplatSettings(near_plane=0.3), "reference")
    system = make_system({"background": background()}, options=options, sh_interval=0.3)
    trainer = StubTrainer(system, [Pruning([0.2, 0.55, 1.0], rule)], max_steps=20)
    trainer.datamodule = DATA
    steps = []
    for step in range(1, 21):
        before = len(rule.asked)
        trainer.walk(step)
        steps += [step] * (len(rule.asked) - before)
    assert steps == [4, 11, 20]
    for scene, frames, _ in rule.asked:
        assert scene is system.scene
        assert [frame.frame_index for frame in frames] == [0, 2, 3, 5, 6]
        assert frames == DATA.split.train
    states = [SceneState(0.2, 0, step=4), SceneState(0.55, 1, step=11), SceneState(1.0, 3, step=20)]
    contexts = [RenderContext(state, options, passes=3, passed=passed) for passed, state in enumerate(states)]
    assert [context for _, _, context in rule.asked] == contexts


def test_the_rows_that_the_rule_names_go_with_their_moments(caplog):
    keep = torch.tensor([True, False, True, True, False])
    kept = torch.ones(4, dtype=torch.bool)
    answer = {"background": Selection(keep, floor_hit=True, removed=2), "rigid": Selection(kept, False, 0)}
    nodes = {"background": background(5), "rigid": rigid(4), "rest": background(3)}
    listener = Listener()
    trainer = StubTrainer(make_system(nodes), [Pruning([0.03], AskedRule(answer)), listener])
    trainer.train(2, frame_at())
    moments = trainer.optimizers[0].state[nodes["background"].rows.means]["exp_avg"].clone()
    means = nodes["rigid"].rows.means
    with caplog.at_level(logging.INFO):
        trainer.walk(3)
    assert labels(nodes["background"]) == [0, 2, 3]
    assert torch.equal(trainer.optimizers[0].state[nodes["background"].rows.means]["exp_avg"], moments[[0, 2, 3]])
    assert nodes["rigid"].rows.means is means
    assert listener.reasons == [(3, "background", "pruning")]
    assert caplog.messages == [
        "step 3: pruning takes 2 of 5 Gaussians of 'background' (a floor holds)",
        "step 3: pruning takes 0 of 4 Gaussians of 'rigid'",
    ]


def test_with_the_papers_rule_what_no_training_view_draws_goes():
    """A row behind the camera has no importance; nodes that are not prunable keep theirs."""
    nodes = {"background": background(6), "rest": background(4, prunable=False)}
    for node in nodes.values():
        set_rows(node, "opacity_logits", dict.fromkeys(range(len(node.rows)), 2.0))
        with torch.no_grad():
            node.rows.means[3, 2] = -5.0
    trainer = StubTrainer(make_system(nodes), [Pruning([0.01], ImportanceRule(gate=False))])
    trainer.datamodule = DATA
    trainer.walk(1)
    assert labels(nodes["background"]) == [0, 1, 2, 4, 5]
    assert len(nodes["rest"].rows) == 4
