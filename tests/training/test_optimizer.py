"""Every parameter with the rate that its node says; what decays, what rests, what scales with the scene."""

import pytest
import torch

from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.training.adam import RowAdam, VisibleAdam
from sparsestreet.training.optimizer import OptimizerSettings, set_rates
from tests.training.stubs import background, group_of, rigid

RATES = {
    "rows": LearningRate(1e-3),
    "means": LearningRate(1.6e-4, 1.6e-6, scale_by_scene_radius=True),
    "sh_rest": LearningRate(2e-2, 5e-3, start=0.4),
}


def scene() -> SceneGraph:
    rates = {
        "rows": LearningRate(3e-3),
        "rotation_deltas": LearningRate(1e-5),
        "translation_deltas": LearningRate(2e-5),
    }
    nodes = {"background": background(3, learning_rates=RATES), "rigid": rigid(4, learning_rates=rates)}
    return SceneGraph(nodes, {"sky": Sky(SkySettings(resolution=2, learning_rates={"texels": LearningRate(1e-2)}))})


def rate(optimizer: torch.optim.Optimizer, street: SceneGraph, name: str) -> float:
    return group_of(optimizer, street.get_parameter(name))["lr"]


def test_rates_scale_with_the_scene_and_decay_log_linearly():
    street = scene()
    optimizer = OptimizerSettings().build(street, radius=10.0)
    assert rate(optimizer, street, "nodes.background.rows.means") == pytest.approx(1.6e-3)
    for progress, means in ((0.0, 1.6e-3), (0.5, 1.6e-4), (0.75, 1.6e-3 * 10**-1.5), (1.0, 1.6e-5)):
        set_rates(optimizer, progress)
        assert rate(optimizer, street, "nodes.background.rows.means") == pytest.approx(means)
        assert rate(optimizer, street, "nodes.background.rows.sh_dc") == pytest.approx(1e-3)
        assert rate(optimizer, street, "effects.sky.texels") == pytest.approx(1e-2)
        assert rate(optimizer, street, "nodes.rigid.rotation_deltas") == 1e-5
        assert rate(optimizer, street, "nodes.rigid.translation_deltas") == 2e-5


@pytest.mark.parametrize(("largest", "means"), [(None, 1.6e-3), (20.0, 1.6e-3), (4.0, 6.4e-4)])
def test_no_more_of_the_radius_than_the_largest_counts_for_rates(largest, means):
    street = scene()
    optimizer = OptimizerSettings(largest_radius=largest).build(street, radius=10.0)
    assert rate(optimizer, street, "nodes.background.rows.means") == pytest.approx(means)  # 1.6e-4 a meter
    assert rate(optimizer, street, "nodes.rigid.rows.means") == 3e-3  # which is not scaled


@pytest.mark.parametrize("visible_only", [False, True])
@pytest.mark.parametrize(
    ("rule", "images", "factor", "betas"),
    [("sqrt", 1, 1.0, (0.9, 0.999)), ("sqrt", 4, 2.0, (0.9**4, 0.999**4)), ("none", 4, 1.0, (0.9, 0.999))],
)
def test_the_rule_for_steps_of_several_images(rule, images, factor, betas, visible_only):
    """Rates times sqrt(n), betas to the power of n; with one image nothing changes, to the bit."""
    street, settings = scene(), OptimizerSettings(batch_rule=rule, visible_only=visible_only)
    single, several = settings.build(street, 10.0), settings.build(street, 10.0, images)
    for one, other in zip(single.param_groups, several.param_groups, strict=True):
        assert (other["lr"], other["initial_lr"]) == (factor * one["lr"], factor * one["initial_lr"])
        assert (one["betas"], other["betas"]) == ((0.9, 0.999), betas)


@pytest.mark.parametrize(("images", "counted"), [(1, 0.25), (4, 1.0), (2, 0.5)])
def test_a_step_of_a_long_log_counts_as_part_of_an_image(images, counted):
    """Four times as long: rates of half, betas to the power of a quarter; four images a step make up for it."""
    street = scene()
    single = OptimizerSettings().build(street, 10.0)
    long = OptimizerSettings(relative_length=4.0).build(street, 10.0, images)
    for one, other in zip(single.param_groups, long.param_groups, strict=True):
        assert other["lr"] == other["initial_lr"] == pytest.approx(one["lr"] * counted**0.5, rel=1e-15)
        assert other["betas"] == (0.9**counted, 0.999**counted)
    resting = OptimizerSettings(relative_length=4.0, visible_only=True).build(street, 10.0, images)
    assert resting.param_groups[0]["betas"] == (0.9**images, 0.999**images)


def distance_each_time(every: int, relative_length: float) -> float:
    """Of rows with random gradients in one step of so many, from one time to the next: the mean of times 20 to 59."""
    street, random = SceneGraph({"background": background(200)}), torch.Generator().manual_seed(3)
    optimizer = OptimizerSettings(relative_length=relative_length).build(street, 1.0)
    rows = street.nodes["background"].rows.get_parameter("sh_dc")
    path = []
    for _ in range(60):
        before, rows.grad = rows.detach().clone(), torch.randn(rows.shape, generator=random)
        optimizer.step()
        rows.grad = torch.zeros_like(rows)
        for _ in range(every - 1):
            optimizer.step()
        path.append(float((rows.detach() - before).abs().mean()))
    return sum(path[20:]) / 40


def test_a_gaussian_moves_as_far_each_time_it_is_seen_however_long_the_log_is():
    """In one step of 5, or of 20 in a log of four times the length."""
    short = distance_each_time(5, 1.0)
    assert distance_each_time(20, 4.0) == pytest.approx(short, rel=0.02)
    assert distance_each_time(20, 1.0) > 3 * short  # without it


def test_lengths_are_positive():
    with pytest.raises(ValueError, match=r"must be > 0 m, got 0\.0: null"):
        OptimizerSettings(largest_radius=0.0)
    with pytest.raises(ValueError, match=r"relative_length must be > 0, got 0\.0: 1 for rates"):
        OptimizerSettings(relative_length=0.0)


@pytest.mark.parametrize("visible_only", [False, True])
def test_a_parameter_with_a_start_rests_before_and_moves_after(visible_only):
    street = scene()
    optimizer = OptimizerSettings(visible_only=visible_only).build(street, radius=1.0)
    resting, moving = (street.nodes["background"].rows.get_parameter(name) for name in ("sh_rest", "sh_dc"))
    first, first_moving = resting.detach().clone(), moving.detach().clone()
    for progress in (0.0, 0.2, 0.39):
        take_step(optimizer, street, progress)
        assert torch.equal(resting, first), progress
    assert not torch.equal(moving, first_moving)
    take_step(optimizer, street, 0.4)
    # The decay counts from the start of the run: 2e-2 * (1/4)^0.4; Adam's step is about one rate.
    assert rate(optimizer, street, "nodes.background.rows.sh_rest") == pytest.approx(2e-2 * 0.25**0.4)
    torch.testing.assert_close(resting.detach(), first - 2e-2 * 0.25**0.4)


def take_step(optimizer: torch.optim.Optimizer, street: SceneGraph, progress: float) -> None:
    for parameter in street.parameters():
        parameter.grad = torch.ones_like(parameter)
    set_rates(optimizer, progress)
    optimizer.step()


@pytest.mark.parametrize("visible_only", [False, True])
def test_the_groups_hold_every_parameter_once(visible_only):
    street = scene()
    optimizer = OptimizerSettings(visible_only=visible_only).build(street, 1.0)
    held = [id(parameter) for group in optimizer.param_groups for parameter in group["params"]]
    assert sorted(held) == sorted(id(parameter) for parameter in street.parameters())


def test_parameters_of_one_rate_are_stepped_together():
    street = scene()
    optimizer = OptimizerSettings().build(street, 1.0)
    # background: all but means and sh_rest; rigid: all rows; two corrections; the sky.
    assert sorted(len(group["params"]) for group in optimizer.param_groups) == [1, 1, 1, 1, 1, 4, 6]
    first, second = (street.nodes["rigid"].rows.get_parameter(name) for name in ("means", "sh_dc"))
    assert group_of(optimizer, first) is group_of(optimizer, second)


def test_the_longest_name_wins_and_a_missing_one_is_an_error():
    rates = {"means": LearningRate(1.0), "rows.means": LearningRate(2.0)}
    with pytest.raises(ValueError, match=r"'rows\.log_scales' has no learning rate: add one to node\.background"):
        OptimizerSettings().build(SceneGraph({"background": background(2, learning_rates=rates)}), 1.0)
    rates["rows"] = LearningRate(3.0)
    street = SceneGraph({"background": background(2, learning_rates=rates)})
    optimizer = OptimizerSettings().build(street, 1.0)
    assert rate(optimizer, street, "nodes.background.rows.means") == 2.0
    assert rate(optimizer, street, "nodes.background.rows.log_scales") == 3.0


@pytest.mark.parametrize(("visible_only", "kind"), [(False, RowAdam), (True, VisibleAdam)])
def test_settings_choose_the_optimizer_and_its_epsilon(visible_only, kind):
    """The default is small enough for mask logits, whose only gradient may be lambda_n / K."""
    default = OptimizerSettings(visible_only=visible_only).build(scene(), 1.0)
    coarse = OptimizerSettings(eps=1e-3, visible_only=visible_only).build(scene(), 1.0)
    assert type(default) is kind
    assert {group["eps"] for group in default.param_groups} == {1e-15}
    assert {group["eps"] for group in coarse.param_groups} == {1e-3}


def masked_scene(mask: StaticMaskSettings | None) -> SceneGraph:
    """The masks' rate is that of the sky, which stands last."""
    rates = RATES | {"rows": LearningRate(3e-3), "mask_logits": LearningRate(1e-2)}
    sky = Sky(SkySettings(resolution=2, learning_rates={"texels": LearningRate(1e-2)}))
    cars = rigid(4, learning_rates=dict.fromkeys(("rows", "rotation_deltas", "translation_deltas"), LearningRate(1e-5)))
    return SceneGraph({"background": background(3, mask=mask, learning_rates=rates), "rigid": cars}, {"sky": sky})


@pytest.mark.parametrize("visible_only", [False, True])
def test_a_checkpoint_of_a_scene_whose_masks_are_gone_fits_one_that_never_had_any(visible_only):
    """The sky shared the masks' group, which stood where the masks did: groups are told apart by their rates."""
    street, bare = masked_scene(StaticMaskSettings(sparsity_weight=1e-3)), masked_scene(None)
    trained, fresh = (OptimizerSettings(visible_only=visible_only).build(one, 1.0) for one in (street, bare))
    for number, parameter in enumerate(street.parameters(), start=1):
        parameter.grad = torch.full_like(parameter, float(number))
    trained.step()
    street.nodes["background"].finish_mask(trained)
    saved = trained.state_dict()
    assert [group["initial_lr"] for group in saved["param_groups"]] != [one["initial_lr"] for one in fresh.param_groups]
    fresh.load_state_dict(saved)
    for name, parameter in bare.named_parameters():
        same = street.get_parameter(name)
        assert torch.equal(fresh.state[parameter]["exp_avg"], trained.state[same]["exp_avg"]), name
        assert group_of(fresh, parameter)["rate"] == group_of(trained, same)["rate"]
