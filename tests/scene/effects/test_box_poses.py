"""Whether nodes learn corrections of boxes, and what is left where they do not."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sparsestreet.scene.build import build_scene
from sparsestreet.scene.effects import BoxPosesSettings, plan_effects
from sparsestreet.scene.nodes import Rigid
from sparsestreet.types import Track
from tests.scene.street import pose, rigid_settings, street_log, training_data

DELTAS = "rotation_deltas", "translation_deltas"


def trembling(meters: float, frames: int = 40) -> Track:
    """A car that drives 1 m a frame, in boxes that are off by ``meters`` on each axis."""
    draw = torch.Generator().manual_seed(0)
    errors = meters * torch.randn(frames, 3, generator=draw)
    poses = [pose(0.0, (5.0 + frame + float(x), float(y), float(z))) for frame, (x, y, z) in enumerate(errors)]
    return Track("car", "Car", torch.arange(frames), torch.stack(poses), torch.tensor([4.0, 2.0, 1.5]))


def cars(when: Any) -> Rigid:
    data = training_data()
    plan = plan_effects({"boxes": BoxPosesSettings(when=when)}, data)
    scene = build_scene(street_log(), data.frames, frozenset(), {"cars": rigid_settings()}, plan, 0)
    assert list(scene.effects) == []
    node = scene.nodes["cars"]
    assert isinstance(node, Rigid)
    return node


def test_where_it_is_off_corrections_are_no_parameters_and_objects_move_as_their_boxes():
    on, off = cars("on"), cars("off")
    assert {name for name, _ in on.named_parameters()} - {name for name, _ in off.named_parameters()} == set(DELTAS)
    assert on.state_dict().keys() == off.state_dict().keys()
    for time in (0.0, 0.3, 1.0):
        assert torch.equal(on.pose_at(time).translations, off.pose_at(time).translations)
        assert off.pose_at(time).translations.grad_fn is None


@pytest.mark.parametrize("smooth", [True, False])
def test_corrections_start_on_a_smooth_path(smooth: bool):
    log = replace(street_log(), tracks=(trembling(0.03),))
    data = training_data(log)
    plan = plan_effects({"boxes": BoxPosesSettings(when="on", smooth=smooth)}, data)
    node = build_scene(log, data.frames, frozenset(), {"cars": rigid_settings()}, plan, 0).nodes["cars"]
    assert isinstance(node, Rigid)
    true = torch.tensor([[5.0 + frame, 0.0, 0.0] for frame in range(40)])
    beside = [(positions - true).square().mean().sqrt() for positions in (
        node.keyframe_translations[0], (node.keyframe_translations + node.translation_deltas)[0].detach()
    )]  # fmt: skip
    # A straight line has two degrees of freedom of 40: a quarter of the errors.
    assert beside[1] < 0.4 * beside[0] if smooth else beside[1] == beside[0]


@pytest.mark.parametrize(("meters", "on"), [(0.0, False), (0.005, False), (0.03, True)])
def test_it_is_called_for_where_boxes_tremble(meters: float, on: bool):
    log = replace(street_log(), tracks=(trembling(meters),))
    found = BoxPosesSettings().detect(training_data(log))
    assert (found.called_for, found.unit, found.threshold) == (on, "cm", 2.0)
    # The median of few differences: within a third.
    assert found.value == pytest.approx(100 * meters * 3**0.5, rel=0.35)


def test_it_is_called_for_where_boxes_were_found_because_these_drift_and_do_not_tremble():
    still = replace(trembling(0.0), name="parked", world_from_object=torch.stack([pose(0.0, (9.0, 9.0, 0.0))] * 40))
    for found, moving in ((True, False), (False, True), (True, True)):
        cars = replace(trembling(0.0), found=moving), replace(still, found=found)
        wanted = BoxPosesSettings().detect(training_data(replace(street_log(), tracks=cars)))
        assert wanted.called_for == moving
        assert ("1 moving objects are found, not annotated" in wanted.reason) == moving
    data = training_data(replace(street_log(), tracks=cars))
    for when in ("auto", "off"):
        (plan,) = plan_effects({"boxes": BoxPosesSettings(when=when)}, data).effects
        assert plan.on == (when == "auto")


def test_too_few_boxes_are_corrected_as_nothing_says_that_they_are_right():
    found = BoxPosesSettings().detect(training_data())
    assert (found.called_for, found.value) == (True, None)
    none = BoxPosesSettings().detect(training_data(replace(street_log(), tracks=())))
    assert not none.called_for
