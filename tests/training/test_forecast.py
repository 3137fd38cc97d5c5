import pytest
import torch

from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import Split
from sparsestreet.evaluation.speed import Timing
from sparsestreet.scene.density import GradientDensity
from sparsestreet.training import forecast as forecast_module
from sparsestreet.training.forecast import (
    CLOSING_SECONDS,
    GROWS_TO,
    GROWTH,
    MOVED_VIEW,
    OPTIMIZER,
    Forecast,
    growth_of,
    largest,
    measured_evaluation,
    measured_step,
    renders_of,
    size_in_words,
)
from sparsestreet.training.moved_views import MovedViews, MovedViewTerm
from sparsestreet.training.moved_views.returns import Colors, Returns, StreetReturns
from tests.training.stubs import SplitFrames, StubTrainer, background, frame_at, make_system, rigid


def forecast(**changes) -> Forecast:
    known = {"step": 0.1, "growth": 3.0, "grown": 0.4, "image": 0.5, "frame": 0.02, "images": 7, "renders": 30}
    return Forecast(**(known | changes))


@pytest.mark.parametrize("progress", [0.0, 0.1, 0.39, 0.4, 0.8])
def test_the_steps_grow_until_no_gaussians_are_added(progress):
    """A sum over 100,000 steps of the run in place of the formula."""
    one = forecast()
    count = 100_000
    done = progress + (1 - progress) * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    # What a step costs now is that at ``progress``; it reaches ``growth`` times as much at ``grown``.
    rise = ((done - progress) / max(one.grown - progress, 1e-12)).clamp(max=1)
    factor = 1 + (one.growth - 1) * rise if progress < one.grown else torch.ones(count)
    expected = float(factor.mean()) * one.step
    assert one.training(1000, progress) == pytest.approx(1000 * expected, rel=1e-4)  # of the sum
    assert one.steps(1000 * expected, progress) == pytest.approx(1000, abs=1)


def test_evaluation_is_its_images_and_its_clocks():
    assert forecast().evaluation == pytest.approx(7 * 0.5 + 30 * 0.02 + CLOSING_SECONDS)
    assert renders_of(Timing(warmup=2, repeats=3, rounds=5), cameras=2, parts=4) == 2 + 3 * 4 + 5 * 2 * 4


def test_a_node_grows_to_its_limit_or_to_a_few_times_its_start():
    kept = background(20, density=None)
    limited = rigid(10, density=GradientDensity(), max_gaussians=50)
    free = background(30, density=GradientDensity(), max_gaussians=None)
    full = background(40, density=GradientDensity(), max_gaussians=35)  # by its start already
    system = make_system({"kept": kept, "limited": limited, "free": free, "full": full})
    most = 20 + 50 + GROWS_TO * 30 + 40
    assert largest(system) == most
    assert size_in_words(system) == f"some {most:,.0f} Gaussians (3 times those of now, as no limit holds them)"
    assert growth_of(system) == pytest.approx((most / 100) ** GROWTH)
    del system.scene.nodes["free"]
    assert size_in_words(system) == "at most 110 Gaussians"


def test_moved_views_take_their_part_of_the_steps(monkeypatch):
    frames = as_frames([frame_at(index) for index in range(3)])
    system, data = make_system({"background": background(20)}), SplitFrames(Split(frames, as_frames(())))
    monkeypatch.setattr(forecast_module, "_seconds", lambda work, device: 2.0)
    assert measured_step(system, data) == 2.0 * OPTIMIZER
    one = Returns(torch.ones(1, 3), Colors(torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)), torch.ones(1))
    settings = MovedViews(every=4, start=0.1, stop=0.9)
    system.moved_views = MovedViewTerm(settings, StreetReturns(one, (0,), (0, 1), {}, ()), seed=0)
    # 0.8 of the run, every fourth step.
    assert measured_step(system, data) == pytest.approx(2.0 * (OPTIMIZER + 0.2 * MOVED_VIEW))
    system.moved_views = MovedViewTerm(settings, StreetReturns(Returns.concatenate([]), (), (0,), {}, ()), seed=0)
    assert measured_step(system, data) == 2.0 * OPTIMIZER


def test_trials_leave_no_trace():
    frames = as_frames([frame_at(index) for index in range(3)])
    data = SplitFrames(Split(frames, as_frames(())))
    system = make_system({"background": background(20)})
    StubTrainer(system, max_steps=10)
    before = {name: value.clone() for name, value in system.state_dict().items()}
    random = torch.get_rng_state()
    system.train()
    assert measured_step(system, data) > 0
    image, frame = measured_evaluation(system, data)
    assert image > 0
    assert frame > 0
    after = system.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert torch.equal(torch.get_rng_state(), random)
    assert all(parameter.grad is None for parameter in system.parameters())
    assert system.scene.training
