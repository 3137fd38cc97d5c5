"""Logs at the edge of what a drive can be: a scene of all nodes works on them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch

from sparsestreet.cli.runs.run import recipe_of
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.lazy import Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.rendering import render
from sparsestreet.scene.state import SceneState
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import BodyPoses, Track
from tests.cli.configurations import composed
from tests.scene.street import NUM_FRAMES, pose, street_log, track

SMALL = (
    "image_points=none",
    "effects.sky.resolution=4",
    "node.background.num_points=60",
    "node.background.min_gaussians=10",
    "node.rigid.points_per_instance=20",
    "node.rigid.box_points=20",
    "node.rigid.min_gaussians=5",
    "node.smpl.body.num_vertices=500",
    "node.deformable.points_per_instance=20",
    "node.deformable.min_gaussians=5",
)


def system_on(log: DrivingLog) -> StreetSystem:
    """With masks, as a run of every node would start it."""
    data = StreetData(log, stride=4, offset=2)
    recipe = recipe_of(composed("method=omnire", "sparsify=masks", *SMALL))
    return recipe.build(data, recipe.plan(data))


def trains(system: StreetSystem, log: DrivingLog) -> dict[str, int]:
    """Every view has a finite image, and every learned number a finite gradient; rows of each node."""
    state = SceneState(0.5, 1, training=True)
    for frame in log.frames:
        rendering = render(system.scene, frame, state)
        assert rendering.rgb.isfinite().all()
        terms = [loss(rendering, frame, system.scene) for loss in system.losses.values() if loss.applies(frame)]
        terms += system.scene.regularizers(frame, rendering.parts, rendering.drawn, state).values()
        torch.stack(terms).sum().backward()
    for name, parameter in system.scene.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name
    for node in system.scene.nodes.values():
        node.rows.resize(node.mask.keep(node.rows).plan())
        node.finish_mask()
    assert all(render(system.scene, frame).rgb.isfinite().all() for frame in log.frames)
    return system.scene.counts()


def with_tracks(*tracks: Track) -> DrivingLog:
    return replace(street_log(), tracks=tracks)


def car(frames: Sequence[int], yaw: Callable[[int], float] = lambda frame: 0.0) -> Track:
    """It drives 2 m a frame, ahead of the camera."""
    return track("car", list(frames), [pose(yaw(frame), (8.0 + 2.0 * frame, 1.0, 0.75)) for frame in frames],
                 class_name="Vehicle")  # fmt: skip


def person(name: str = "person", valid: Sequence[bool] = (True,) * NUM_FRAMES, place: float = 0.0) -> Track:
    """Upright and facing along x, with a pose in the frames that are valid."""
    frames = list(range(NUM_FRAMES))
    poses = [pose(0.0, (6.0 + 0.5 * frame + place, 0.5, 0.9)) for frame in frames]
    walking = track(name, frames, poses, (0.6, 0.6, 1.8), "Pedestrian")
    rotations = torch.zeros(NUM_FRAMES, 24, 4)
    rotations[..., 0] = 1
    # The body's y is the world's z, its z the world's x.
    rotations[:, 0] = torch.tensor([0.5, 0.5, 0.5, 0.5])
    return replace(walking, body=BodyPoses(rotations, torch.tensor(valid), torch.zeros(10)))


LOGS: dict[str, tuple[DrivingLog, set[str]]] = {
    "no boxes": (with_tracks(), {"background"}),
    "no people": (with_tracks(car(range(NUM_FRAMES))), {"background", "rigid"}),
    "a person and a car": (with_tracks(car(range(NUM_FRAMES)), person()), {"background", "rigid", "smpl"}),
    "no lidar": (
        replace(with_tracks(car(range(NUM_FRAMES)), person()), sweeps=Sweeps.of(())),
        {"background", "rigid", "smpl"},
    ),
    "a track of a single frame": (with_tracks(car([1])), {"background"}),
    "a turn by 180 degrees": (
        with_tracks(car(range(NUM_FRAMES), lambda frame: math.pi * (frame % 2))),
        {"background", "rigid"},
    ),
    "a track that leaves and comes back": (with_tracks(car([0, 1, 4])), {"background", "rigid"}),
    "a person without pose in some frames": (
        with_tracks(person(valid=(False, True, False, False, True))),
        {"background", "smpl"},
    ),
    "a person with a pose in a held-out frame only": (
        with_tracks(person(valid=(False, False, True, False, False))),
        {"background"},
    ),
    "two people in one box": (with_tracks(person("one"), person("two")), {"background", "smpl"}),
}


@pytest.mark.parametrize("case", LOGS)
def test_a_scene_of_all_nodes_trains_on_it(case: str):
    log, expected = LOGS[case]
    counts = trains(system_on(log), log)
    assert counts.keys() == expected
    assert all(counts.values())
