import pytest
import torch
from torch import nn

from sparsestreet.training.optimizer import LearningRate, OptimizerSettings


class Scene(nn.Module):
    def __init__(self):
        super().__init__()
        self.rows = nn.Module()
        self.rows.means = nn.Parameter(torch.zeros(2, 3))
        self.texels = nn.Parameter(torch.zeros(4))


def test_rates_scale_with_the_scene_and_decay_log_linearly():
    optimization = OptimizerSettings(
        {"means": LearningRate(1.6e-4, 1.6e-6, scale_by_scene_radius=True), "texels": LearningRate(1e-2)}
    )
    scene = Scene()
    optimizer = optimization.build(scene, radius=10.0)
    by_name = {group["name"]: group for group in optimizer.param_groups}
    assert by_name["rows.means"]["lr"] == pytest.approx(1.6e-3)
    optimization.set_rates(optimizer, 0.5)
    assert by_name["rows.means"]["lr"] == pytest.approx(1.6e-4)  # half way in the logarithm
    assert by_name["texels"]["lr"] == pytest.approx(1e-2)


def test_the_groups_hold_every_parameter_once():
    scene = Scene()
    optimizer = OptimizerSettings({"means": LearningRate(1.0), "texels": LearningRate(1.0)}).build(scene, 1.0)
    held = [id(parameter) for group in optimizer.param_groups for parameter in group["params"]]
    assert sorted(held) == sorted(id(parameter) for parameter in scene.parameters())


def test_the_longest_name_wins_and_a_missing_one_is_an_error():
    optimization = OptimizerSettings({"means": LearningRate(1.0), "rigid.rows.means": LearningRate(2.0)})
    assert optimization.rate_of("nodes.rigid.rows.means").initial == 2.0
    assert optimization.rate_of("nodes.background.rows.means").initial == 1.0
    with pytest.raises(ValueError, match="log_scales' has no learning rate"):
        optimization.rate_of("nodes.rigid.rows.log_scales")
    with pytest.raises(ValueError, match="no learning rate"):
        optimization.rate_of("submeans")


def test_adams_epsilon_is_small_enough_for_mask_logits():
    optimizer = OptimizerSettings({"means": LearningRate(1.0), "texels": LearningRate(1.0)}).build(Scene(), 1.0)
    assert optimizer.defaults["eps"] == 1e-15
