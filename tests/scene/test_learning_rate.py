"""Which rate a parameter takes, and how it goes over a run."""

import math

import pytest

from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate, matching_rate
from tests.scene.street import (
    POSE_RATES,
    RATES,
    background,
    background_settings,
    keyframes,
    pose,
    random_rows,
    rigid,
    static_mask,
    track,
)

ONE, TWO, THREE = LearningRate(1.0), LearningRate(2.0), LearningRate(3.0)


def test_a_mapping_of_its_fields_is_a_rate():
    assert LearningRate.of({"initial": 1.0, "final": 0.1, "start": 0.5}) == LearningRate(1.0, 0.1, start=0.5)
    assert LearningRate.of(ONE) is ONE
    settings = background_settings(1, learning_rates={"means": {"initial": 2.0}})
    assert settings.learning_rates == {"means": TWO}


@pytest.mark.parametrize("said", [{"inital": 1.0}, {"final": 1.0}, {"initial": 1.0, "stop": 0.5}, 0.1])
def test_anything_else_is_no_rate(said):
    with pytest.raises(ValueError, match="a learning rate has initial, and may have final, scale_by_scene_radius, sta"):
        LearningRate.of(said)


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("rows.means", ONE),  # a column
        ("mlp.0.weight", TWO),  # a module
        ("deform.mlp.2.bias", TWO),
        ("mlp.0.bias", THREE),  # the longest of mlp and mlp.0.bias
        ("head.mlp.0.bias", THREE),
    ],
)
def test_a_key_is_a_column_or_a_module_and_the_longest_wins(name: str, rate: LearningRate):
    rates = {"mlp.0.bias": THREE, "mlp": TWO, "means": ONE}
    assert matching_rate(name, rates, "somewhere") is rate
    assert matching_rate(name, dict(reversed(rates.items())), "somewhere") is rate


@pytest.mark.parametrize("name", ["rows.mean", "rows.means2", "rows.my_means", "rowsmeans"])
def test_a_key_matches_whole_words_only(name: str):
    with pytest.raises(ValueError, match=f"parameter '{name}' has no learning rate"):
        matching_rate(name, {"means": ONE}, "somewhere")


def test_a_missing_rate_names_where_to_add_it():
    rates = {"log_scales": ONE, "mlp": TWO}
    message = (
        "parameter 'rows.means' has no learning rate: add one to node.road.learning_rates, which has log_scales, mlp"
    )
    with pytest.raises(ValueError, match=message):
        matching_rate("rows.means", rates, "node.road.learning_rates")
    with pytest.raises(ValueError, match="which has none"):
        matching_rate("rows.means", {}, "node.road.learning_rates")


def test_decay_is_log_linear_from_the_start_of_the_run():
    rate = LearningRate(1e-2, final=1e-4)
    assert [rate.factor(progress) for progress in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.1, 0.01], rel=1e-12)
    assert rate.factor(0.25) == pytest.approx(math.sqrt(0.1), rel=1e-12)
    # Past the end the rate stays.
    assert rate.factor(1.7) == rate.factor(1.0)


def test_without_a_final_rate_it_is_constant():
    assert [LearningRate(0.3).factor(progress) for progress in (0.0, 0.4, 1.0)] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("final", [None, 1e-4])
def test_a_late_start_rests_and_then_is_where_it_would_have_been(final: float | None):
    late, early = LearningRate(1e-2, final=final, start=0.3), LearningRate(1e-2, final=final)
    assert [late.factor(progress) for progress in (0.0, 0.29999)] == [0.0, 0.0]
    for progress in (0.3, 0.6, 1.0):
        assert late.factor(progress) == early.factor(progress) > 0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"initial": 0.0}, "must be > 0, got initial=0.0"),
        ({"initial": float("nan")}, "must be > 0, got initial=nan"),
        ({"initial": 1.0, "final": 0.0}, "and final=0.0"),
        ({"initial": 1.0, "start": 1.1}, r"in \[0, 1\], got start=1.1"),
        ({"initial": 1.0, "start": -0.1}, r"in \[0, 1\], got start=-0.1"),
    ],
)
def test_impossible_rates_are_refused(values: dict, message: str):
    with pytest.raises(ValueError, match=message):
        LearningRate(**values)


def scene_of(learning_rates: dict[str, LearningRate]) -> SceneGraph:
    mask = static_mask()
    road = background(random_rows(2, 0, mask=mask), mask, learning_rates=RATES | {"means": TWO})
    boxes = keyframes([track("car", [0, 1], [pose(0, (5.0, 0, 0))] * 2)], 2)
    rows = random_rows(2, 0, instances=random_rows(2, 0).means.detach()[:, 0].long() * 0)
    return SceneGraph(
        {"road": road, "cars": rigid(rows, boxes, learning_rates=learning_rates)},
        {"sky": Sky(SkySettings(resolution=2))},
    )


def test_the_scene_gives_every_parameter_the_rate_of_its_own_node():
    scene = scene_of(RATES | POSE_RATES | {"means": ONE})
    rates = scene.learning_rates()
    assert rates.keys() == {name for name, _ in scene.named_parameters()}
    assert (rates["nodes.road.rows.means"], rates["nodes.cars.rows.means"]) == (TWO, ONE)
    assert rates["nodes.cars.rotation_deltas"] is POSE_RATES["rotation_deltas"]
    assert rates["nodes.road.rows.mask_logits"] is RATES["mask_logits"]
    assert rates["effects.sky.texels"] == LearningRate(0.01)
