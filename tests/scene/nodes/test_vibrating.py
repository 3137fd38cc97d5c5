"""A street without boxes: where its Gaussians are at a time, what fades, what is learned, what a file keeps."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.nodes import Vibrating, VibratingSettings
from sparsestreet.scene.state import FINISHED, SceneState
from tests.scene.street import RATES, background_settings, random_rows, static_mask, street_log, training_data, view_at
from tests.typed import as_a

NUM_FRAMES = 31
DURATION = 0.6  # 0.02 a frame
NAMES = ("velocities", "life_peaks", "log_life_spans")
OWN_RATES = RATES | {name: LearningRate(0.02) for name in NAMES}


def vibrating_settings(**changes) -> VibratingSettings:
    said = {"kind": VibratingSettings, "learning_rates": OWN_RATES, "smoothing_probability": 0.0}
    return as_a(VibratingSettings, background_settings(**(said | changes)))


def vibrating_rows(count: int, seed: int = 0, mask=None, dtype: torch.dtype = torch.float32) -> Rows:
    """Peaks all over the drive, life spans of 0.05 to 0.5, velocities of some tens of meters per unit of time."""
    plain = random_rows(count, seed, mask=mask, dtype=dtype)
    generator = torch.Generator().manual_seed(seed + 1)
    columns = {
        "velocities": 20 * torch.randn(count, 3, generator=generator, dtype=dtype),
        "life_peaks": DURATION * torch.rand(count, generator=generator, dtype=dtype),
        "log_life_spans": torch.log(0.05 + 0.45 * torch.rand(count, generator=generator, dtype=dtype)),
    }
    return Rows(dict(plain.named_parameters()) | columns, transient=plain.transient)


def vibrating(count: int = 20, *, mask=None, dtype: torch.dtype = torch.float32, **changes) -> Vibrating:
    rows = vibrating_rows(count, mask=mask, dtype=dtype)
    return Vibrating(vibrating_settings(**changes), rows, frame_periods=NUM_FRAMES - 1.0, seed=7, mask=mask)


def training(progress: float) -> SceneState:
    return SceneState(progress, 1, training=True)


def by_hand(node: Vibrating, time: float, shift: float = 0.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means and opacities of PVG's formulas at another time by ``shift``, and the factors, in float64."""
    columns = {name: value.detach().double() for name, value in node.rows.columns().items()}
    age = time * DURATION + shift - columns["life_peaks"]
    rate = 2 * math.pi / 0.2
    means = columns["means"] + columns["velocities"] * (torch.sin(age * rate) / rate)[:, None]
    spans = columns["log_life_spans"].exp()
    means -= shift * columns["velocities"] * torch.exp(-0.5 * spans / 0.2)[:, None]
    factors = torch.exp(-0.5 * age**2 / spans**2)
    opacities = torch.sigmoid(columns["opacity_logits"]) * factors
    return means, opacities.where(factors > 0.05, 0), factors


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_means_and_opacities_are_those_of_the_formulas(time: float):
    node = vibrating(200)
    gaussians = node.gaussians_at(view_at(time), FINISHED)
    means, opacities, factors = by_hand(node, time)
    # A swing turns by up to 19 rad: float32 knows it to 2e-6 of a swing of up to 3 m.
    torch.testing.assert_close(gaussians.means.double(), means, rtol=0, atol=1e-5)
    torch.testing.assert_close(gaussians.opacities.double(), opacities, rtol=1e-5, atol=1e-7)
    hidden = factors <= 0.05
    assert 0 < hidden.sum() < 200
    assert torch.equal(gaussians.opacities == 0, hidden)
    assert torch.equal(gaussians.scales == 0, hidden[:, None].expand(200, 3))
    torch.testing.assert_close(gaussians.scales[~hidden], node.rows.log_scales[~hidden].exp())


def test_the_swing_repeats_with_the_cycle_and_a_finished_scene_is_not_smoothed():
    """0.2 of 0.6 is a third of the drive."""
    node = vibrating(smoothing_probability=1.0)
    first, again, between = (node.gaussians_at(view_at(time), FINISHED).means for time in (0.1, 0.1 + 1 / 3, 0.2))
    torch.testing.assert_close(first, again, rtol=0, atol=1e-5)
    torch.testing.assert_close(first.double(), by_hand(node, 0.1)[0], rtol=0, atol=1e-5)
    assert not torch.allclose(first, between, atol=0.1)


@pytest.mark.lengthy
def test_in_training_some_steps_take_rows_from_another_time():
    node = vibrating(smoothing_probability=0.5, min_factor=1e-9)
    shifts = []
    for step in range(400):
        state = training(step / 400)
        raw = node.raw_at(view_at(0.5), state)
        shift = node._shift(state)
        shifts.append(shift)
        if step < 40:
            means, opacities, _ = by_hand(node, 0.5, shift)
            torch.testing.assert_close(raw.means.double(), means, rtol=0, atol=1e-5)
            torch.testing.assert_close(raw.opacity_logits.double().sigmoid(), opacities, rtol=1e-5, atol=1e-6)
    moved = torch.tensor([shift for shift in shifts if shift])
    # 0.5 of 400 within four standard errors of 10; uniform over 1.5 frames of 0.02.
    assert abs(len(moved) - 200) < 40
    assert moved.abs().max() <= 0.03
    assert abs(float(moved.mean())) < 4 * 0.03 / math.sqrt(3 * 200)
    assert float(moved.std()) == pytest.approx(0.03 / math.sqrt(3), rel=0.15)
    never = vibrating()
    assert {never._shift(training(step / 50)) for step in range(50)} == {0.0}


def test_the_same_step_of_the_same_seed_draws_the_same():
    """So a resumed run repeats the uninterrupted one, whatever was drawn in between."""
    node, same = vibrating(smoothing_probability=1.0), vibrating(smoothing_probability=1.0)
    other = Vibrating(node.settings, vibrating_rows(20), frame_periods=NUM_FRAMES - 1.0, seed=8)
    torch.rand(3)
    states = [training(step / 9) for step in range(9)]
    assert [node._shift(state) for state in states] == [same._shift(state) for state in reversed(states)][::-1]
    assert [node._shift(state) for state in states] != [other._shift(state) for state in states]


def test_gradients_are_those_of_finite_differences():
    node = vibrating(6, dtype=torch.float64, smoothing_probability=1.0, min_factor=1e-12)
    names = [*NAMES, "means", "opacity_logits"]

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        state = dict(zip([f"rows.{name}" for name in names], values, strict=True))
        raw = torch.func.functional_call(node, state, (view_at(0.4), training(0.3)))
        return raw.means, raw.opacity_logits

    node.forward = node.raw_at
    assert torch.autograd.gradcheck(outputs, [getattr(node.rows, name) for name in names])


def test_hidden_rows_get_no_gradient_and_the_others_all_theirs():
    node = vibrating(60)
    gaussians = node.gaussians_at(view_at(0.5), FINISHED)
    hidden = by_hand(node, 0.5)[2] <= 0.05
    (gaussians.opacities.sum() + gaussians.scales.sum()).backward()
    for name in ("opacity_logits", "log_life_spans", "life_peaks", "log_scales"):
        gradient = node.rows.columns()[name].grad
        assert not gradient[hidden].any(), name
        assert gradient[~hidden].all(), name


def test_the_regularizer_is_the_mean_length_of_the_mean_velocities():
    node = vibrating(velocity_weight=0.5)
    raw = node.raw_at(view_at(0.0), FINISHED)
    columns = {name: value.detach().double() for name, value in node.rows.columns().items()}
    lengths = columns["velocities"].norm(dim=1) * torch.exp(-2.5 * columns["log_life_spans"].exp())
    drawn = torch.arange(len(lengths)) % 2 == 0
    term = node.own_regularizers(raw, drawn, FINISHED)["velocity"]
    assert float(term.detach()) == pytest.approx(0.5 * float(lengths[drawn].mean()), rel=1e-6)
    with torch.no_grad():
        node.rows.velocities.zero_()  # where it starts, and where a norm has no derivative
    node.own_regularizers(raw, drawn, FINISHED)["velocity"].backward()
    assert node.rows.velocities.grad.isfinite().all()


def test_a_mask_hides_what_time_shows_and_the_other_way_round():
    mask = static_mask()
    node = vibrating(60, mask=mask)
    closed = torch.arange(60) % 3 == 0
    with torch.no_grad():
        node.rows.mask_logits[closed] = -9.0
    gaussians = node.gaussians_at(view_at(0.5), FINISHED)
    hidden = by_hand(node, 0.5)[2] <= 0.05
    assert torch.equal(gaussians.opacities == 0, hidden | closed)


def test_it_starts_at_rest_and_returns_peak_when_they_were_measured():
    data = training_data()
    settings = vibrating_settings(lidar=60, near=40, initial_life_span=0.3)
    node = settings.build(data, torch.Generator().manual_seed(3))
    duration = 0.02 * 4
    at = {tuple(p): sweep.index / 4 * duration for sweep in data.sweeps for p in sweep.points.tolist()}
    measured = [at[tuple(p)] for p in node.rows.means[:60].tolist()]
    assert node.rows.life_peaks[:60].tolist() == pytest.approx(measured, rel=1e-6)
    guessed = node.rows.life_peaks[60:].detach() / duration
    assert (guessed.min() < 0.2, guessed.max() > 0.8, len(guessed.unique())) == (True, True, 40)
    first = replace(settings, random_life_peaks=False).build(data, torch.Generator().manual_seed(3)).rows.life_peaks
    assert first[:60].tolist() == pytest.approx(measured, rel=1e-6)
    assert not first[60:].any()
    assert not node.rows.velocities.any()
    torch.testing.assert_close(node.rows.log_life_spans.exp(), torch.full((100,), 0.3))
    still = background_settings(lidar=60, near=40).build(data, torch.Generator().manual_seed(3))
    assert torch.equal(node.rows.means, still.rows.means)
    again = settings.build(data, torch.Generator().manual_seed(3))
    assert torch.equal(again.rows.life_peaks, node.rows.life_peaks)
    assert node.seed == again.seed


def test_a_log_of_one_frame():
    log = street_log()
    log = replace(log, frames=log.frames[:1], sweeps=log.sweeps[:1], num_frames=1)
    node = vibrating_settings(lidar=20, near=10).build(training_data(log), torch.Generator().manual_seed(0))
    assert not node.rows.life_peaks.any()
    assert (node.gaussians_at(view_at(0.0), training(0.5)).opacities > 0).all()


def test_a_node_without_rows():
    node = vibrating(0, smoothing_probability=1.0)
    raw = node.raw_at(view_at(0.3), training(0.1))
    assert len(raw) == 0
    assert float(node.own_regularizers(raw, torch.zeros(0, dtype=torch.bool), FINISHED)["velocity"].detach()) == 0.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cycle": 0.0}, "cycle is a time and must be above 0, got 0.0"),
        ({"frame_time": -1.0}, "frame_time is a time"),
        ({"initial_life_span": 0.0}, "initial_life_span is a time"),
        ({"min_factor": 0.0}, "min_factor must lie between 0 and 1, got 0.0"),
        ({"smoothing_probability": 1.5}, r"smoothing_probability must lie in \[0, 1\], got 1.5"),
        ({"num_points": -1}, "num_points must be >= 0"),
    ],
)
def test_settings_that_cannot_be(changes: dict, said: str):
    with pytest.raises(ValueError, match=said):
        vibrating_settings(lidar=1, **changes)
