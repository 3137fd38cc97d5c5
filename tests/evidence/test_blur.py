"""Motion during an exposure, against a car on a circle and against cases that are computed by hand."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.evidence.motion import blur_length, exposure_motions
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Shutter, View
from tests.evidence.test_shear import CAMERA, sweep


def view(frame: int, camera: Camera = CAMERA, seconds: float | None = None, exposure: float = 0.01) -> View:
    seconds = 0.1 * frame if seconds is None else seconds
    return View(replace(camera, exposure=exposure), seconds / 0.4, frame, 0, seconds)


def on_a_circle(frame: int) -> View:
    """Forward at 8 m/s, to the right at 0.5 rad/s: around a point 16 m to the right."""
    angle = 0.05 * frame
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([16 * (1 - math.cos(angle)), 0.0, 16 * math.sin(angle)])
    return view(frame, replace(CAMERA, camera_from_world=inverse(pose).float()))


def test_motion_is_that_between_the_images_around():
    motions = exposure_motions([on_a_circle(frame) for frame in (2, 0, 1)])
    assert set(motions) == {(0, 0), (1, 0), (2, 0)}
    # A chord of 0.1 rad is sin(0.05) / 0.05 of its arc, and float32 poses are good to 1e-6 m of 0.16 m.
    middle = motions[1, 0]
    torch.testing.assert_close(middle.translation, torch.tensor([0.0, 0.0, 0.08]), rtol=5e-4, atol=1e-6)
    torch.testing.assert_close(middle.rotation, torch.tensor([0.0, 0.005, 0.0]), rtol=1e-3, atol=1e-6)
    assert (middle.seconds, middle.span) == (0.01, pytest.approx(0.025))
    # At an end the way to the only neighbor: its chord is turned by half of the angle between them.
    assert motions[0, 0].translation.norm() == pytest.approx(0.08, rel=1e-3)


def test_motion_is_the_same_however_the_world_is_turned():
    """Motions are in the camera's axes, so a world whose z is up, far from its origin, changes none of them."""
    straight = [on_a_circle(frame) for frame in range(3)]
    world = torch.eye(4)
    world[:3, :3] = torch.tensor([[0.0, 0.8, 0.6], [0.0, -0.6, 0.8], [1.0, 0.0, 0.0]])
    world[:3, 3] = torch.tensor([3.0, -20.0, 7.0])
    turned = [replace(one, camera=replace(one.camera, camera_from_world=one.camera.camera_from_world @ world))
              for one in straight]  # fmt: skip
    expected, found = exposure_motions(straight), exposure_motions(turned)
    assert expected.keys() == found.keys()
    for indices, motion in expected.items():
        # A millionth of the world's 20 m, and of a turn, in float32 poses.
        torch.testing.assert_close(found[indices].translation, motion.translation, rtol=0, atol=2e-5)
        torch.testing.assert_close(found[indices].rotation, motion.rotation, rtol=0, atol=1e-6)


def test_a_declared_readout_says_it_too():
    shutter = Shutter(torch.tensor([0.3, 0.0, 0.0]), torch.tensor([0.0, 0.02, 0.0]), "left", seconds=0.03, span=0.06)
    lone = view(0, replace(CAMERA, shutter=shutter))
    found = exposure_motions([lone])[0, 0]
    torch.testing.assert_close(found.translation, shutter.translation / 3)
    torch.testing.assert_close(found.rotation, shutter.rotation / 3)
    assert (found.seconds, found.span) == (0.01, pytest.approx(0.02))


@pytest.mark.parametrize(
    "views",
    [
        [view(0, exposure=0.0), view(1, exposure=0.0)],
        [replace(view(0), seconds=None), replace(view(1), seconds=None)],
        [view(0)],
        [view(0), replace(view(1), camera_index=1)],
    ],
    ids=["no exposure", "no clock", "one image", "one image of each camera"],
)
def test_without_an_exposure_or_a_motion_there_is_none(views):
    assert exposure_motions(views) == {}


def test_the_length_is_that_of_the_longest_tenth():
    """8 m/s to the side for 10 ms, 100 px: 0.8 px at 10 m, four times as many at 2.5 m."""
    sideways = [torch.eye(4) for _ in range(2)]
    for frame, pose in enumerate(sideways):
        pose[0, 3] = -0.8 * frame
    views = [view(frame, replace(CAMERA, camera_from_world=pose)) for frame, pose in enumerate(sideways)]
    motions = exposure_motions(views)
    far, near = (0.0, 0.0, 10.0), (0.0, 0.0, 2.5)
    few = Sweeps.of((sweep(*[far] * 19, near),))
    many = Sweeps.of((sweep(*[far] * 8, near, near),))
    assert blur_length(views[:1], few, motions).pixels == pytest.approx(0.8, rel=1e-3)
    assert blur_length(views[:1], many, motions).pixels == pytest.approx(3.2, rel=1e-3)
