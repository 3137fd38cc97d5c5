"""A removal that asks what depth would lose: against closed forms, and where color has nothing to say."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.pruning import LeaveOneOutRule
from sparsestreet.pruning.ranges import depth_changes, depth_costs
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame
from tests.pruning.test_rules import CONTEXT, frame_of, scene_of
from tests.typed import there

OPACITIES, DEPTHS = [0.6, 0.5, 0.9], [4.0, 4.2, 4.5]
PIXELS = 63
"""Of the image; every disc covers all of them evenly."""


def turned(scene: SceneGraph, frame: Frame) -> tuple[SceneGraph, Frame]:
    """The same view of the same discs in a world that is turned and shifted."""
    angle = math.radians(100)
    world_from_old = torch.eye(4)
    world_from_old[:3, :3] = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    world_from_old[:3, 3] = torch.tensor([30.0, -7.0, 12.0])
    rows = scene.nodes["background"].rows
    with torch.no_grad():
        rows.means.copy_(rows.means @ world_from_old[:3, :3].T + world_from_old[:3, 3])
    pose = frame.camera.camera_from_world @ torch.linalg.inv(world_from_old)
    return scene, replace(frame, camera=replace(frame.camera, camera_from_world=pose))


def inverse_depth(opacities: list[float], depths: list[float] = DEPTHS) -> float:
    """Of a pixel, by hand: what discs show, front to back."""
    through, summed = 1.0, 0.0
    for opacity, z in zip(opacities, depths, strict=True):
        summed, through = summed + through * opacity / z, through * (1 - opacity)
    return summed


def test_changes_of_depth_are_those_of_the_view_without_each_row():
    """Of the pixels with a return only those whose depth is right count."""
    drawn = inverse_depth(OPACITIES)
    depth = torch.zeros(7, 9)
    depth[1, 2], depth[3, 4], depth[3, 5] = 1.05 / drawn, 0.97 / drawn, 1.0 / drawn
    depth[5, 5], depth[5, 6] = 1.11 / drawn, 0.89 / drawn
    scene = scene_of(OPACITIES, DEPTHS)
    rows = scene.nodes["background"].rows
    with torch.no_grad():
        rows.log_scales.fill_(6.0)  # flat to 1e-4 across the image, also where their centers are far outside of it
        rows.means[:, 0] = torch.tensor([1.0, -2.0, 3.0])
    scene, frame = turned(scene, replace(frame_of(scene, 20), depth=depth))
    with torch.no_grad():
        error, changes = depth_changes(scene, frame, there(frame.depth), CONTEXT)
    right = [1.05, 0.97, 1.0]
    assert float(error) == pytest.approx(sum((one - 1) ** 2 for one in right), rel=1e-3)  # of float32's 1e-7 of 0.03
    for row, change in enumerate(changes.tolist()):
        without = inverse_depth([0.0 if one == row else opacity for one, opacity in enumerate(OPACITIES)])
        expected = sum((one * (1 - without / drawn)) ** 2 for one in right)
        assert change == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("depths", "recorded"), [([0.3, 0.4, 0.45], 0.49), ([90.0, 91.0, 92.0], 90.5)])
def test_returns_that_are_too_near_or_too_far_count_nowhere(depths, recorded):
    scene = scene_of(OPACITIES, depths)
    with torch.no_grad():
        error, changes = depth_changes(scene, frame_of(scene, 20), torch.full((7, 9), recorded), CONTEXT)
    assert float(error) == 0.0
    assert changes.tolist() == [0.0, 0.0, 0.0]


def test_costs_are_of_all_views_together():
    scene = scene_of(OPACITIES, DEPTHS)
    frames = [replace(frame_of(scene, 20), depth=torch.full((7, 9), depth)) for depth in (4.0, 4.15)]
    with torch.no_grad():
        (first, changed), (second, also) = (depth_changes(scene, one, there(one.depth), CONTEXT) for one in frames)
    expected = (changed + also) / (first + second)
    assert first > 2 * second > 0
    torch.testing.assert_close(depth_costs(scene, frames, CONTEXT)["background"], expected, rtol=1e-12, atol=0.0)


def test_passes_ask_each_instant_once_all_its_cameras_together():
    """Two cameras that fire together, instants with gaps: passes of two have 2, 9 and 5, 11."""
    scene = scene_of(OPACITIES, DEPTHS)
    shown = [(11, 0), (2, 0), (2, 1), (5, 0), (5, 1), (9, 1)]
    frames = [
        replace(
            frame_of(scene, 20), frame_index=instant, camera_index=camera, depth=torch.full((7, 9), 4.0 + 0.01 * place)
        )
        for place, (instant, camera) in enumerate(shown)
    ]
    for passed, places in ((0, [1, 2, 5]), (1, [0, 3, 4])):
        chosen = [frames[place] for place in places]
        expected = depth_costs(scene, chosen, CONTEXT)["background"]
        found = depth_costs(scene, frames, replace(CONTEXT, passes=2, passed=passed))["background"]
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=0.0)


def test_where_images_miss_neither_the_depth_says_which_of_two_stays():
    """A wall, and one of its own color behind it: either shows all images."""
    scene = scene_of([0.999, 0.999], [8.0, 4.0])
    frame = replace(frame_of(scene, 20), depth=torch.full((7, 9), 4.0))
    without = replace(frame, frame_index=1, depth=None)
    # The op lets a hundredth of the light through, so three steps of 255 count as none.
    rule = LeaveOneOutRule(0.1, noticeable=3 / 255, keep=0.5)
    for depth, kept in ((0.0, [True, False]), (1.0, [False, True])):
        selection = replace(rule, depth=depth).select(scene, [without, frame, without], CONTEXT)["background"]
        assert selection.keep.tolist() == kept


def test_the_budget_is_of_images_alone():
    """The depth's order, far rows last; the first row that images miss by more than is allowed ends the removal."""
    scene = scene_of([0.05, 0.3, 0.1], [2.0, 3.0, 4.0])
    frame = replace(
        frame_of(scene, 20), depth=torch.full((7, 9), 1.05 / inverse_depth([0.05, 0.3, 0.1], [2.0, 3.0, 4.0]))
    )
    costs = LeaveOneOutRule(0.1).costs(scene, [frame], CONTEXT)["background"]
    of_depth = depth_costs(scene, [frame], CONTEXT)["background"]
    assert costs.argsort().tolist() == [0, 2, 1]
    assert of_depth.argsort().tolist() == [2, 0, 1]
    for weight, allowed, kept in (
        (1e6, 0.99 * costs[2], [True, True, True]),
        (1e6, 1.01 * costs[2], [True, True, False]),
        (1e-6, 0.99 * costs[2], [False, True, True]),
    ):
        rule = LeaveOneOutRule(10 * math.log10(1 + float(allowed)), depth=weight)
        assert rule.select(scene, [frame], CONTEXT)["background"].keep.tolist() == kept


def test_a_return_behind_the_recording_car_tells_nothing():
    """The hood is no part of the scene, and the lidar looks over it."""
    scene = scene_of(OPACITIES, DEPTHS)
    hood = torch.zeros(7, 9, dtype=torch.bool)
    hood[5:] = True
    # Below the hood other errors than above it: as many returns alike would cancel in the share.
    depth = torch.where(hood, 4.1, 4.2)
    shown = replace(frame_of(scene, 20), depth=depth)
    hidden, left_out = replace(shown, ego=hood), replace(shown, depth=depth.masked_fill(hood, 0.0))
    every, behind, above = (depth_costs(scene, [one], CONTEXT)["background"] for one in (shown, hidden, left_out))
    assert torch.equal(behind, above)
    assert not torch.equal(behind, every)


def test_a_log_without_lidar_is_asked_for_images_alone():
    scene = scene_of(OPACITIES, DEPTHS)
    assert depth_costs(scene, [frame_of(scene, 20)], CONTEXT)["background"].tolist() == [0.0, 0.0, 0.0]
