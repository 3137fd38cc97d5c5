"""Shear of a readout, against cases that are computed by hand."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.evidence.motion import blur_length, box_jitter, exposure_motions, readout_shear
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Shutter, Sweep, Track, View
from tests.scene.street import pose

INTRINSICS = torch.tensor([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(torch.eye(4), INTRINSICS, 80, 60)


def view(shutter: Shutter | None, frame: int = 0) -> View:
    return View(replace(CAMERA, shutter=shutter), 0.0, frame, 0)


def shutter(*translation: float, rotation: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Shutter:
    return Shutter(torch.tensor(translation), torch.tensor(rotation))


def sweep(*points: tuple[float, float, float], index: int = 0) -> Sweep:
    count = len(points)
    return Sweep(index, 0.0, torch.tensor(points), torch.zeros(count, 3), torch.zeros(count, dtype=torch.bool))


def test_a_camera_that_moves_aside():
    """100 px of focal length, 0.3 m: 3 px at 10 m. Points behind the camera and beside the image do not count."""
    points = sweep((0.0, 0.0, 10.0), (1.0, 0.5, 10.0), (0.0, 0.0, -1.0), (50.0, 0.0, 10.0))
    found = readout_shear([view(shutter(0.3, 0.0, 0.0)), view(None)], Sweeps.of((points,)))
    assert found.pixels == pytest.approx(3.0, abs=1e-4)
    assert (found.views, found.points) == (1, 2)


def test_a_camera_that_turns():
    """Radians times the focal length, at any distance, where a point is on the axis."""
    turning = shutter(0.0, 0.0, 0.0, rotation=(0.0, 0.02, 0.0))
    found = readout_shear([view(turning)], Sweeps.of((sweep((0.0, 0.0, 7.0), (0.0, 0.0, 70.0)),)))
    assert found.pixels == pytest.approx(2.0, rel=1e-3)  # tan x = x + x^3 / 3


def test_a_camera_that_looks_at_a_point_while_it_passes():
    """To the right by 0.3 m and to the left by 0.03 rad: what is 10 m ahead stays, at 5 m half of the 6 px is left."""
    passing = shutter(0.3, 0.0, 0.0, rotation=(0.0, -0.03, 0.0))
    for depth, pixels in ((10.0, 0.0), (5.0, 3.0)):
        found = readout_shear([view(passing)], Sweeps.of((sweep((0.0, 0.0, depth)),)))
        assert found.pixels == pytest.approx(pixels, abs=1e-2)


def test_without_lidar_points_are_ten_meters_away():
    assert readout_shear([view(shutter(0.3, 0.0, 0.0))], Sweeps.of(())).pixels == pytest.approx(3.0, rel=1e-3)


def test_a_view_is_measured_at_the_sweep_of_its_frame():
    """Frames have gaps: the second sweep is that of frame 5, four times as near as that of frame 0."""
    sweeps = Sweeps.of((sweep((0.0, 0.0, 10.0)), sweep((0.0, 0.0, 2.5), index=5)))
    assert readout_shear([view(shutter(0.3, 0.0, 0.0), 5)], sweeps).pixels == pytest.approx(12.0, rel=1e-3)
    assert readout_shear([view(shutter(0.3, 0.0, 0.0), 0)], sweeps).pixels == pytest.approx(3.0, rel=1e-3)


def test_the_error_is_that_of_the_mean_over_views():
    views = [view(shutter(0.2 + 0.1 * frame, 0.0, 0.0), frame) for frame in range(3)]
    sweeps = Sweeps.of(tuple(sweep((0.0, 0.0, 10.0), index=frame) for frame in range(3)))
    found = readout_shear(views, sweeps)
    assert found.pixels == pytest.approx(3.0, abs=1e-3)  # 2, 3 and 4 px
    assert found.error == pytest.approx(3**-0.5, abs=1e-3)


def test_without_a_shutter_there_is_none():
    with pytest.raises(ValueError, match="no view has one"):
        readout_shear([view(None)], Sweeps.of(()))


def view_blur(frame: int, camera: Camera = CAMERA, seconds: float | None = None, exposure: float = 0.01) -> View:
    seconds = 0.1 * frame if seconds is None else seconds
    return View(replace(camera, exposure=exposure), seconds / 0.4, frame, 0, seconds)


def on_a_circle(frame: int) -> View:
    """Forward at 8 m/s, to the right at 0.5 rad/s: around a point 16 m to the right."""
    angle = 0.05 * frame
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([16 * (1 - math.cos(angle)), 0.0, 16 * math.sin(angle)])
    return view_blur(frame, replace(CAMERA, camera_from_world=inverse(pose).float()))


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
    lone = view_blur(0, replace(CAMERA, shutter=shutter))
    found = exposure_motions([lone])[0, 0]
    torch.testing.assert_close(found.translation, shutter.translation / 3)
    torch.testing.assert_close(found.rotation, shutter.rotation / 3)
    assert (found.seconds, found.span) == (0.01, pytest.approx(0.02))


@pytest.mark.parametrize(
    "views",
    [
        [view_blur(0, exposure=0.0), view_blur(1, exposure=0.0)],
        [replace(view_blur(0), seconds=None), replace(view_blur(1), seconds=None)],
        [view_blur(0)],
        [view_blur(0), replace(view_blur(1), camera_index=1)],
    ],
    ids=["no exposure", "no clock", "one image", "one image of each camera"],
)
def test_without_an_exposure_or_a_motion_there_is_none(views):
    assert exposure_motions(views) == {}


def test_the_length_is_that_of_the_longest_tenth():
    """8 m/s to the side for 10 ms, 100 px: 0.8 px at 10 m, four times as many at 2.5 m."""
    sideways = [torch.eye(4) for _ in range(2)]
    for frame, moved in enumerate(sideways):
        moved[0, 3] = -0.8 * frame
    views = [view_blur(frame, replace(CAMERA, camera_from_world=moved)) for frame, moved in enumerate(sideways)]
    motions = exposure_motions(views)
    far, near = (0.0, 0.0, 10.0), (0.0, 0.0, 2.5)
    few = Sweeps.of((sweep(*[far] * 19, near),))
    many = Sweeps.of((sweep(*[far] * 8, near, near),))
    assert blur_length(views[:1], few, motions).pixels == pytest.approx(0.8, rel=1e-3)
    assert blur_length(views[:1], many, motions).pixels == pytest.approx(3.2, rel=1e-3)


def car(
    *, meters: float = 0.0, degrees: float = 0.0, brake: float = 0.0, turn: float = 0.0, seed: int = 0, period=0.1
) -> Track:
    """40 boxes of a car with errors of each (meters on each axis, degrees); braking and turning."""
    draw = torch.Generator().manual_seed(seed)
    shift = meters * torch.randn(40, 3, generator=draw, dtype=torch.float64)
    times = period * torch.arange(40, dtype=torch.float64)
    ahead = 10 * times - 0.5 * brake * times**2
    yaw = turn * ahead / 10 + torch.deg2rad(degrees * torch.randn(40, generator=draw, dtype=torch.float64))
    centers = (torch.stack((ahead, turn * ahead**2 / 20, torch.zeros(40)), 1) + shift).tolist()
    poses = [pose(angle, (x, y, z)) for angle, (x, y, z) in zip(yaw.tolist(), centers, strict=True)]
    return Track("car", "Car", torch.arange(40), torch.stack(poses), torch.tensor([4.0, 2.0, 1.5]))


def test_the_value_is_the_size_of_the_errors():
    found = box_jitter([car(meters=0.02, seed=seed) for seed in range(8)], frozenset())
    assert found is not None
    # 40 boxes of each of 8 cars: a median of 300 errors an axis is good to 5 %, its least of three to a little more.
    assert found.value == pytest.approx(0.02 * 3**0.5, rel=0.12)
    assert 0 < found.error < 0.15 * found.value
    assert len(found.by_track) == 8


def test_a_turn_of_a_box_counts_by_what_it_moves():
    found = box_jitter([car(degrees=1.0, seed=seed) for seed in range(8)], frozenset())
    assert found is not None
    assert found.value == pytest.approx(torch.deg2rad(torch.tensor(1.0)).item() * (2**2 + 1**2) ** 0.5, rel=0.3)


@pytest.mark.parametrize("period", [0.1, 0.5], ids=["10 Hz", "2 Hz"])
def test_braking_and_turning_cars_do_not_tremble(period: float):
    # A quarter of the threshold of 2 cm, at 2 frames a second, too.
    found = box_jitter([car(brake=0.4, turn=0.02, period=period)], frozenset())
    assert found is not None
    assert found.value < 0.005


def test_one_stray_box_does_not_count():
    track = car(meters=0.001)
    track.world_from_object[20, 1, 3] += 5.0
    found = box_jitter([track, car(meters=0.001, seed=1)], frozenset())
    assert found is not None
    assert found.value < 0.004


def test_boxes_of_held_out_frames_are_not_looked_at():
    track = car()
    track.world_from_object[::10, 1, 3] += 5.0
    found = box_jitter([track], frozenset(range(0, 40, 10)))
    assert found is not None
    assert found.value < 1e-9


def test_few_boxes_say_nothing():
    assert box_jitter([], frozenset()) is None
    assert box_jitter([car()], frozenset(range(0, 40, 4))) is None
