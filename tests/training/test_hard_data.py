"""Hard cases of data (docs/stability.md): each is trained to its end, and what the user is told is checked."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch

from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_warnings import log_warnings
from sparsestreet.scene.effects import EffectPlan, ExposureSettings
from sparsestreet.scene.nodes import BackgroundSettings
from sparsestreet.scene.rendering import render
from sparsestreet.training.recipe import Recipe
from sparsestreet.training.run import CPU_TRAINER, build, fit
from sparsestreet.types import Frame, Track
from tests.evidence import wall
from tests.scene.street import pose, rigid_settings, track

PERIOD = 100_000_000
"""Nanoseconds: 6 m/s."""
FRAMES = list(range(wall.INSTANTS))


def box(name: str, size: tuple[float, float, float] = (4.0, 2.0, 1.5), kind: str = "Car") -> Track:
    """Driven along the wall, 8 m away from the cameras; a meter an instant."""
    return track(name, FRAMES, [pose(0.0, (1.0 * frame, 0.0, 8.0)) for frame in FRAMES], size, kind)


def wall_log(gain: Callable[[int, int], torch.Tensor] = lambda instant, camera: torch.ones(3)) -> DrivingLog:
    """A car in front of the wall, seen by two cameras whose images have stamps."""
    frames = [
        replace(frame, stamp=PERIOD * frame.indices[0], seconds=0.1 * frame.indices[0]) for frame in wall.frames(gain)
    ]
    return DrivingLog(
        "wall", as_frames(frames), wall.sweeps(), (box("car"),), wall.INSTANTS, 2, torch.eye(4, dtype=torch.float64)
    )


def changed(change: Callable[[Frame], Frame], *tracks: Track) -> DrivingLog:
    log = wall_log()
    return replace(log, frames=as_frames([change(frame) for frame in log.frames]), tracks=(*log.tracks, *tracks))


def late(frame: Frame) -> Frame:
    """The images of instant 6 say that they were taken 50 ms later."""
    return replace(frame, seconds=frame.seconds + 0.05) if frame.indices[0] == 6 else frame


def covered(frame: Frame) -> Frame:
    return replace(frame, image=torch.zeros_like(frame.image)) if frame.indices[1] == 1 else frame


def rolled(frame: Frame) -> Frame:
    """As if x and y were each other, in the second camera."""
    turn = torch.tensor([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    if frame.indices[1] == 0:
        return frame
    return replace(frame, camera=replace(frame.camera, camera_from_world=turn @ frame.camera.camera_from_world))


def other_world(frame: Frame) -> Frame:
    """Poses in a world whose axes are named another way than those of lidar and boxes."""
    turn = torch.tensor([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    return replace(frame, camera=replace(frame.camera, camera_from_world=frame.camera.camera_from_world @ turn))


@dataclass(frozen=True)
class Case:
    log: DrivingLog
    said: Sequence[str]
    """Of each doubt, in order."""


CASES = {
    "nothing": Case(wall_log(), ()),
    "a wrong stamp": Case(
        changed(late),
        [f"camera {name} is accelerated by 80 m/s^2 around frame 6: check pose and stamp" for name in "01"],
    ),
    "axes of a camera": Case(changed(rolled), ["if camera 1 is followed along its poses as if it stood still: check"]),
    "axes of poses": Case(
        changed(other_world), [f"camera {name} sees hardly any return of the lidar" for name in "01"]
    ),
    "a covered camera": Case(
        changed(covered),
        [
            "camera 1 shows a single gray level in 11 of 11 images, as if it were covered: leave it out",
            "have a mean gray level of 50 of 255, and a noise of 0.1 levels",
        ],
    ),
    "a track twice": Case(
        changed(lambda frame: frame, box("twin")), ["objects car and twin (Car) have one box in 12 frames: remove one"]
    ),
    "a person in a car": Case(
        changed(lambda frame: frame, box("driver", (0.6, 0.6, 1.2), "Pedestrian")),
        ["object driver (Pedestrian) is inside the box of car (Car) in 12 frames: both start from what is seen there"],
    ),
}


def trained(log: DrivingLog, tmp_path, **effects) -> EffectPlan:
    """Three steps with a node for all boxes; every number and every image is finite."""
    nodes = {
        "background": BackgroundSettings(num_points=300, mask=None, masked=False, density=None, prunable=False),
        "boxes": rigid_settings(classes=("Car", "Pedestrian"), points_per_instance=50, box_points=50),
    }
    data, recipe = StreetData(log, stride=12, offset=5), Recipe(nodes, effects=effects)
    plan = recipe.plan(data)
    system = build(recipe, data, plan)
    fit(system, data, [], CPU_TRAINER, tmp_path, max_steps=3)
    assert all(parameter.isfinite().all() for parameter in system.scene.parameters())
    assert all(render(system.scene, frame).rgb.isfinite().all() for frame in data.split.held_out)
    return plan


@pytest.mark.lengthy
@pytest.mark.parametrize("name", CASES)
def test_it_is_trained_and_the_user_is_told(name: str, tmp_path, caplog):
    case = CASES[name]
    with caplog.at_level(logging.WARNING, "sparsestreet.training.run"):
        trained(case.log, tmp_path)
    told = [record.message for record in caplog.records if record.name == "sparsestreet.training.run"]
    assert len(told) == len(case.said), told
    assert all(words in line for words, line in zip(case.said, told, strict=True)), told


@pytest.mark.lengthy
def test_an_exposure_that_jumps_is_planned_for(tmp_path):
    log = wall_log(lambda instant, camera: torch.full((3,), 1.0 if instant < 6 else 0.5))
    assert log_warnings(log) == ()
    (planned,) = trained(log, tmp_path, exposure=ExposureSettings()).effects
    assert planned.on


def test_what_tires_can_do_is_no_jump():
    """9 m/s^2 for a second, and poses that tremble by 20 cm."""

    def braked(frame: Frame) -> Frame:
        draw = torch.Generator().manual_seed(frame.indices[0])
        shifted = frame.camera.camera_from_world.clone()
        shifted[0, 3] += 4.5 * (0.1 * frame.indices[0]) ** 2 + 0.2 * float(torch.randn((), generator=draw))
        return replace(frame, camera=replace(frame.camera, camera_from_world=shifted))

    assert not [doubt for doubt in log_warnings(changed(braked)) if "accelerated" in doubt]


def test_boxes_beside_each_other_share_nothing():
    """A cyclist a hand's breadth beside the car, and one who passes within it for a quarter of the time."""
    beside = replace(box("beside", (1.8, 0.6, 1.7)), world_from_object=box("x").world_from_object + _aside(1.3))
    passing = box("passing", (1.8, 0.6, 1.7)).world_from_object.clone()
    passing[3:] += _aside(-1.2)
    log = changed(lambda frame: frame, beside, replace(box("passing", (1.8, 0.6, 1.7)), world_from_object=passing))
    assert log_warnings(log) == ()


def _aside(meters: float) -> torch.Tensor:
    shift = torch.zeros(4, 4, dtype=torch.float64)
    shift[1, 3] = meters
    return shift


def test_a_camera_that_stands_is_right_whatever_its_axes_are():
    def still(frame: Frame) -> Frame:
        first = rolled(wall.frame(0, frame.indices[1], torch.ones(3)))
        return replace(frame, camera=first.camera, image=first.image)

    assert log_warnings(changed(still)) == ()
