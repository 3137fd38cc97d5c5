"""Bodies of people whom nobody posed: a person walks a curve in a turned world far from its origin, at a gait that is
not the usual one, before a lidar that sees one side; some sweeps are missing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import JOINTS, Bones, posed_bones, skin
from sparsestreet.scene.body import BuiltinBody, surface
from sparsestreet.tracking.bodies import with_bodies
from sparsestreet.tracking.gait import Gait, Walk, usual_curves
from sparsestreet.types import BodyPoses, Sweep, Track
from tests.scene.people import BODY_IN_BOX
from tests.training.stubs import frame_at

FRAMES, HEIGHT, MISSING, HELD_OUT = 31, 1.8, (7, 8, 19), frozenset({5, 15, 25})
SECONDS = np.arange(FRAMES) / 10
WORLD = torch.from_numpy(quat.to_matrix(quat.from_rotation_vector(torch.tensor([0.02, -0.03, 2.1]))).double().numpy())
FAR = torch.tensor([800.0, -1200.0, 30.0], dtype=torch.float64)
LIDAR = torch.tensor([4.0, -9.0, 1.0], dtype=torch.float64)
LEGS = [JOINTS.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee")]


def boxes(speed: float) -> Tensor:
    """It turns by 20 degrees a second."""
    yaw = np.radians(20.0) * SECONDS
    places = np.cumsum(np.stack((np.cos(yaw), np.sin(yaw)), 1) * speed / 10, 0)
    poses = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    turns = torch.zeros(FRAMES, 3, dtype=torch.float64)
    turns[:, 2] = torch.from_numpy(yaw)
    poses[:, :3, :3] = quat.to_matrix(quat.from_rotation_vector(turns))
    poses[:, :2, 3], poses[:, 2, 3] = torch.from_numpy(places), HEIGHT / 2
    return poses


def stride(speed: float) -> Tensor:
    """Rotations of the joints at each frame: knees bend more than usual, arms less, steps are shorter."""
    curves = usual_curves() * torch.tensor([1.1, 1.25, 1.0, 0.6, 1.0])[:, None]
    gait = Gait(curves[None], torch.tensor([2.0], dtype=torch.float64), torch.tensor([1.07], dtype=torch.float64))
    return gait.joints(Walk.along(SECONDS, boxes(speed)[:, :2, 3].numpy(), HEIGHT))[0]


def returns(poses: Tensor, joints: Tensor, seed: int) -> list[Tensor]:
    """Points of each frame on the skin that faces the lidar, 1.5 cm off, in the turned world."""
    template, generator = BuiltinBody().load(), torch.Generator().manual_seed(seed)
    vertices, rest = template.shaped(torch.zeros(10), HEIGHT)
    attached, weights = template.influences()
    _, normals = surface(vertices, template.faces)
    found, still = [], torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(vertices), 4)
    for pose, turns in zip(poses, joints.float(), strict=True):
        bones = posed_bones(rest[None], turns[None])
        skinned = skin(vertices, still, Bones(bones.transforms[0], bones.quaternions[0]), attached, weights)
        facing = (quat.to_matrix(quat.normalized(skinned[1])) @ normals[:, :, None])[:, :, 0]
        in_box = skinned[0].double() @ BODY_IN_BOX.T
        in_box[:, 2] += HEIGHT / 2 - float(in_box[:, 2].max())
        points, outward = (in_box @ pose[:3, :3].T + pose[:3, 3], facing.double() @ BODY_IN_BOX.T @ pose[:3, :3].T)
        seen = torch.nonzero(((LIDAR - points) * outward).sum(1) > 0)[:, 0]
        seen = seen[torch.randperm(len(seen), generator=generator)[:40]]
        noisy = points[seen] + 0.015 * torch.randn(len(seen), 3, generator=generator, dtype=torch.float64)
        found.append((noisy @ WORLD.T + FAR).float())
    return found


def log_of(speed: float, *, seen: bool = True, seed: int = 0) -> DrivingLog:
    poses, joints = boxes(speed), stride(speed)
    points = returns(poses, joints, seed) if seen else [torch.zeros(0, 3)] * FRAMES
    sweeps = [
        Sweep(index, index / (FRAMES - 1), own, torch.full_like(own, 0.5), torch.zeros(len(own), dtype=torch.bool))
        for index, own in enumerate(points)
        if index not in MISSING
    ]
    there = torch.eye(4, dtype=torch.float64)
    there[:3, :3], there[:3, 3] = WORLD, FAR
    size = torch.tensor([0.7, 0.7, HEIGHT])
    track = Track("she", "Pedestrian", torch.arange(FRAMES), there @ poses, size)
    car = Track("car", "Car", torch.arange(2), there @ poses[:2], torch.tensor([4.0, 2.0, 1.5]))
    frames = as_frames([replace(frame_at(0), frame_index=index, time=index / (FRAMES - 1)) for index in range(FRAMES)])
    return DrivingLog("walk", frames, Sweeps.of(tuple(sweeps)), (track, car), FRAMES, 1, torch.eye(4).double())


def body_of(log: DrivingLog) -> BodyPoses:
    she, car = with_bodies(log, HELD_OUT, {"Pedestrian"}).tracks
    assert car.body is None
    assert she.body is not None
    return she.body


def degrees_off(found: Tensor, true: Tensor) -> float:
    """Mean angle between rotations of hips and knees."""
    cosines = (found[:, LEGS].double() * true[:, LEGS].double()).sum(-1).abs().clamp(max=1)
    return float(torch.rad2deg(2 * torch.arccos(cosines)).mean())


@pytest.fixture(scope="module")
def walk() -> DrivingLog:
    return log_of(1.4)


@pytest.fixture(scope="module")
def fitted(walk: DrivingLog) -> BodyPoses:
    return body_of(walk)


@pytest.mark.lengthy
def test_the_gait_is_that_of_the_returns(walk, fitted):
    """The usual gait is 26 degrees off at a wrong phase and 3.4 at the right one, of which half are left."""
    true = stride(1.4)
    assert degrees_off(fitted.rotations, true) < 2.5
    unseen = body_of(log_of(1.4, seen=False)).rotations
    assert degrees_off(unseen, true) > 15.0
    # Upright, facing where the box does.
    root = quat.to_matrix(fitted.rotations[:, 0].double())
    assert torch.allclose(root, walk.tracks[0].world_from_object[:, :3, :3] @ BODY_IN_BOX, atol=1e-6)
    assert fitted.valid.tolist() == [frame not in HELD_OUT for frame in range(FRAMES)]


@pytest.mark.lengthy
def test_what_is_held_out_is_not_looked_at(walk, fitted):
    """Its sweeps are those of somebody else, its boxes far away; the answer has the same bits."""
    wrong = [
        replace(sweep, points=sweep.points.flip(0) + 0.3) if sweep.index in HELD_OUT else sweep
        for sweep in walk.sweeps.where(lambda index: True)
    ]
    she, car = walk.tracks
    poses = she.world_from_object.clone()
    poses[list(HELD_OUT), 2, 3] += 5.0
    other = replace(walk, sweeps=Sweeps.of(tuple(wrong)), tracks=(replace(she, world_from_object=poses), car))
    assert torch.equal(body_of(other).rotations, fitted.rotations)


def test_who_stands_does_not_swing_and_who_has_a_body_keeps_it():
    standing = body_of(log_of(0.02, seen=False))
    legs = standing.rotations[:, LEGS]
    assert torch.equal(legs, legs[:1].expand_as(legs))
    log = log_of(0.02, seen=False)
    own = replace(log, tracks=(replace(log.tracks[0], body=standing), log.tracks[1]))
    assert with_bodies(own, HELD_OUT, {"Pedestrian"}).tracks[0].body is standing
    assert all(track.body is None for track in with_bodies(log, HELD_OUT, {"Cyclist"}).tracks)


def test_a_stride_is_as_long_as_its_speed_and_height_say():
    """A step of 0.7 m and 108 of them a minute at 1.26 m/s: sqrt(60 x 0.0065 x 1.26) = 0.701 m."""
    places = np.stack((1.26 * SECONDS, 0 * SECONDS), 1)
    walk = Walk.along(SECONDS, places, 1.7)
    assert walk.strides[-1] == pytest.approx(1.26 * 3.0 / (2 * np.sqrt(60 * 0.0065 * 1.26)), rel=1e-3)
    assert walk.swing.min() == 1.0
    assert Walk.along(SECONDS[:1], places[:1], 1.7).strides.tolist() == [0.0]
