"""One step of training: what is rendered, summed, logged and scheduled."""

import math
from typing import Any

import pytest
import torch
from jaxtyping import Bool
from lightning import Callback, Trainer
from torch import Tensor

from sparsestreet.ops import SplatSettings
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.nodes import Background
from sparsestreet.scene.rendering import RenderOptions, SceneRendering, render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.adam import VisibleAdam
from sparsestreet.training.losses import Photometric
from sparsestreet.training.optimizer import OptimizerSettings
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Frame, View
from tests.training.stubs import StubTrainer, background, fit, frame_at, group_of, make_rows, make_system, rigid

RATES = {"rows": LearningRate(1e-3), "means": LearningRate(1e-2, 1e-4, scale_by_scene_radius=True)}


class Rates(Callback):
    """The rate of the means at each of Lightning's steps."""

    def __init__(self) -> None:
        self.seen: list[float] = []

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: StreetSystem, optimizer: Any) -> None:
        self.seen.append(group_of(trainer.optimizers[0], pl_module.scene.nodes["background"].rows.means)["lr"])


def test_rates_decay_from_step_to_step():
    """Steps 0, 1, 2, 3 of 4 at fractions 0, 1/4, 1/2, 3/4 of two decades, times a radius of 5 m."""
    rates = Rates()
    system = make_system({"background": background(3, learning_rates=RATES)}, radius=5.0)
    fit(system, [rates], 4, frame_at())
    assert rates.seen == pytest.approx([5e-2 * 10 ** (-2 * step / 4) for step in range(4)])


def test_a_step_moves_by_its_own_rate():
    """Adam's first step is one rate long: that of the step which training goes on at, not the initial one."""
    node = background(3, learning_rates=RATES)
    trainer = StubTrainer(make_system({"background": node}), max_steps=4)
    trainer.global_step = 2
    before = node.rows.means.detach().clone()
    trainer.train(1, frame_at())
    moved = (node.rows.means.detach() - before).abs()
    # 1e-2 * 10 m half way through two decades; means are known to 2e-7.
    assert float(moved.max()) == pytest.approx(1e-2, rel=1e-3)


def test_the_optimizer_is_the_configured_one_at_the_radius_of_the_scene():
    nodes = {"background": background(3, learning_rates=RATES)}
    system = make_system(nodes, optimizer=OptimizerSettings(eps=1e-9, visible_only=True), radius=7.0)
    (optimizer,) = StubTrainer(system).optimizers
    assert type(optimizer) is VisibleAdam
    assert optimizer.defaults["eps"] == 1e-9
    assert group_of(optimizer, system.scene.nodes["background"].rows.means)["lr"] == pytest.approx(7e-2)


class Watched(Background):
    """Writes down in which states it is asked for its Gaussians, and whether autocast is on."""

    def __init__(self, settings: Any, count: int) -> None:
        super().__init__(settings, make_rows(count))
        self.asked: list[SceneState] = []

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        self.asked.append(state)
        return super().raw_at(view, state)

    def own_regularizers(self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState) -> dict[str, Tensor]:
        self.asked.append(state)
        return {"size": 0.25 * self.rows.log_scales.sum(), "nothing": torch.zeros(())}


def watched(**changes: Any) -> tuple[Watched, StubTrainer]:
    node = Watched(background(1).settings, 5)
    return node, StubTrainer(make_system({"background": node}, **changes), max_steps=10)


def test_one_more_degree_of_harmonics_after_each_interval():
    """Steps of 10 with an interval of 0.2; 0.6 / 0.2 is 2.9999999999999996 in floats and means 3."""
    node, trainer = watched(sh_interval=0.2)
    trainer.train(10, frame_at())
    degrees = [state.sh_degree for state in node.asked[::2]]
    assert degrees == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]  # a node uses as many as it has
    assert [state.progress for state in node.asked[::2]] == pytest.approx([step / 10 for step in range(10)])


def test_an_interval_of_nothing_is_refused():
    with pytest.raises(ValueError, match="sh_interval must be > 0"):
        make_system({"background": background(1)}, sh_interval=0.0)


@pytest.mark.parametrize(("step", "used"), [(0, 0), (2, 3), (4, 8), (6, 15), (8, 15)])
def test_only_harmonics_in_use_have_a_gradient(step, used):
    node = background(12)
    trainer = StubTrainer(make_system({"background": node}, sh_interval=0.2), max_steps=10)
    trainer.global_step = step
    trainer.train(1, frame_at())
    gradient = node.rows.sh_rest.grad
    felt = torch.zeros(15, dtype=torch.bool) if gradient is None else gradient.abs().sum((0, 2)) > 0
    assert felt.tolist() == [True] * used + [False] * (15 - used)


def test_late_harmonics_rest_between_their_steps():
    """Every third step from half of ten on, without momentum in between; step 0 has the first coefficient alone."""
    node = background(12)
    trainer = StubTrainer(
        make_system({"background": node}, sh_interval=0.01, sh_every=3, sh_every_from=0.5), max_steps=10
    )
    moved = {"sh_rest": [], "sh_dc": []}
    for step in range(10):
        before = {name: getattr(node.rows, name).detach().clone() for name in moved}
        trainer.train(1, frame_at())
        for name, steps in moved.items():
            steps += [step] * (not torch.equal(getattr(node.rows, name), before[name]))
    assert moved == {"sh_rest": [1, 2, 3, 4, 6, 9], "sh_dc": list(range(10))}


@pytest.mark.parametrize(("every", "start"), [(0, 0.5), (2, -0.1), (2, 1.5)])
def test_harmonics_that_never_move_are_refused(every, start):
    with pytest.raises(ValueError, match=rf"sh_every must be >= 1 step .* got {every} and {start}: sh_every=1"):
        make_system({"background": background(1)}, sh_every=every, sh_every_from=start)


def test_nodes_know_whether_they_are_trained():
    node, trainer = watched()
    trainer.train(1, frame_at())
    assert [state.training for state in node.asked] == [True, True]  # Gaussians and regularizers
    validate(trainer, frame_at())
    assert [state.training for state in node.asked[2:]] == [False]
    assert not trainer.system.state().training


@torch.no_grad()  # as Lightning calls it
def validate(trainer: StubTrainer, frame: Frame) -> None:
    trainer.system.on_validation_epoch_start()
    trainer.system.validation_step(frame, 0)
    trainer.system.on_validation_epoch_end()


class Term:
    """A loss that answers a number times the mean of the image, for some frames."""

    def __init__(self, weight: float, frames: set[int] | None = None) -> None:
        self.weight, self.frames = weight, frames
        self.given: list[tuple[SceneRendering, Frame, SceneGraph]] = []
        self.autocast = False

    def applies(self, frame: Frame) -> bool:
        return self.frames is None or frame.frame_index in self.frames

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Tensor:
        self.given.append((rendering, frame, scene))
        self.autocast = torch.is_autocast_enabled("cpu")
        return self.weight * rendering.rgb.mean()


def test_the_loss_is_the_sum_of_what_applies_and_of_the_nodes_own_terms():
    first, second, never = Term(2.0), Term(0.5, {1}), Term(9.0, {7})
    node, trainer = watched(losses={"first": first, "second": second, "never": never})
    system = trainer.system
    for index, factor in ((1, 2.5), (0, 2.0)):
        frame = frame_at(index)
        loss = system.training_step(frame, 0)
        mean = float(render(system.scene, frame, system.state(), system.options).rgb.detach().mean())
        size = 0.25 * float(node.rows.log_scales.detach().sum())
        assert loss.item() == pytest.approx(factor * mean + size, rel=1e-5)
        said = system.said.newest
        logged = {name.removeprefix("train/"): value for name, value in said.items() if "train/" in name}
        expected = {"first": 2 * mean, "second": 0.5 * mean, "background/size": size, "background/nothing": 0.0}
        if index == 0:
            del expected["second"]
        assert logged == pytest.approx(expected, rel=1e-5)
    assert never.given == []
    (rendering, frame, scene), _ = first.given
    assert frame.frame_index == 1
    assert scene is system.scene
    assert first.given[-1][0] is system.rendering is not rendering


def test_every_term_has_a_gradient():
    node, trainer = watched(losses={"first": Term(1.0)})
    trainer.system.training_step(frame_at(), 0).backward()
    assert bool((node.rows.log_scales.grad != 0).all())  # 0.25 of the regularizer
    assert bool(node.rows.sh_dc.grad.any())  # of the image


def test_losses_are_computed_in_full_precision_under_autocast():
    term = Term(1.0)
    _, trainer = watched(losses={"term": term, "photometric": Photometric()})
    expected = trainer.system.training_step(frame_at(), 0).item()
    with torch.autocast("cpu", torch.bfloat16):
        assert trainer.system.training_step(frame_at(), 0).item() == expected
    assert not term.autocast


def psnr_by_hand(scene: SceneGraph, frame: Frame, state: SceneState, options: RenderOptions | None = None) -> float:
    image = render(scene, frame, state, options or RenderOptions()).rgb.detach().double().clamp(0, 1)
    squares = (image - frame.image.double() / 255).square()
    return -10 * math.log10(float(squares.mean()))


def sunny() -> Sky:
    """Brighter than white: what is not clamped shows."""
    return Sky(SkySettings(resolution=2, initial_color=1.4))


def test_validation_logs_the_psnr_of_the_clamped_image_as_training_renders_it():
    options = RenderOptions(SplatSettings(near_plane=2.7), "reference")
    nodes = {"background": background(), "rigid": rigid()}
    trainer = StubTrainer(make_system(nodes, effects={"sky": sunny()}, options=options, sh_interval=0.2), max_steps=10)
    trainer.global_step = 3
    frame = frame_at(2)
    validate(trainer, frame)
    ((name, value, how),) = trainer.log_calls
    assert (name, how) == ("val/psnr", {"batch_size": 1})
    state = SceneState(0.3, 1)
    assert value == pytest.approx(psnr_by_hand(trainer.system.scene, frame, state, options), abs=1e-4)
    # Each of these would have been seen.
    assert abs(value - psnr_by_hand(trainer.system.scene, frame, state)) > 1e-3
    assert abs(value - psnr_by_hand(trainer.system.scene, frame, SceneState(0.3, 0), options)) > 1e-3


def test_training_logs_the_running_psnr_and_the_number_of_gaussians():
    nodes = {"background": background(12), "rigid": rigid(4)}
    trainer = StubTrainer(make_system(nodes, effects={"sky": sunny()}), max_steps=10)
    values = []
    for index in range(3):
        frame = frame_at(index)
        values.append(psnr_by_hand(trainer.system.scene, frame, trainer.system.state()))
        trainer.train(1, frame)
        logged = {name: value for name, value, _ in trainer.log_calls}
        assert logged["psnr"] == pytest.approx(sum(values) / len(values), abs=1e-4)
        assert logged["gaussians"] == 16.0
    assert max(values) - min(values) > 0.01
    assert [how["step"] for name, _, how in trainer.log_calls if name == "psnr"] == [0, 1, 2]


def test_a_resumed_run_goes_on_with_the_mean_of_the_last_steps():
    trainer, resumed = (StubTrainer(make_system({"background": background(3)}), max_steps=10) for _ in range(2))
    trainer.train(2, frame_at())
    checkpoint: dict[str, Any] = {}
    trainer.system.on_save_checkpoint(checkpoint)
    resumed.system.on_load_checkpoint(checkpoint)
    assert list(resumed.system.train_psnr) == list(trainer.system.train_psnr)
    assert len(resumed.system.train_psnr) == 2


def test_between_two_logs_nothing_is_computed_for_them():
    trainer = StubTrainer(make_system({"background": background(3)}))
    trainer.log_every_n_steps = 3
    said = []
    for _ in range(6):
        trainer.train(1, frame_at())
        said.append(len(trainer.log_calls))
        trainer.log_calls.clear()
    assert [count > 0 for count in said] == [False, False, True] * 2
    assert len(trainer.system.train_psnr) == 2
    trainer.log_every_n_steps = 0  # Lightning's word for never
    trainer.train(3, frame_at())
    assert trainer.log_calls == []


def test_options_reach_the_training_rendering():
    """Without a near plane, a Gaussian that it hides is drawn."""
    radii = {}
    for near in (0.01, 3.5):
        node = background()
        options = RenderOptions(SplatSettings(near_plane=near))
        trainer = StubTrainer(make_system({"background": node}, options=options))
        trainer.system.training_step(frame_at(), 0)
        radii[near] = trainer.system.rendering.splats.radii
    hidden = node.rows.means.detach()[:, 2] < 3.5
    assert 0 < int(hidden.sum()) < 20
    assert bool((radii[0.01][hidden] > 0).any())
    assert not bool((radii[3.5][hidden] > 0).any())
