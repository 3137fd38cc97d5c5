"""Hand-made people: tracks with body poses, and the node that models them."""

from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sparsestreet.data.lazy import Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import JOINTS, NUM_JOINTS
from sparsestreet.scene.body import BuiltinBody
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.nodes import Smpl, SmplSettings
from sparsestreet.types import BodyPoses, Sweep, Track
from tests.scene.street import NUM_FRAMES, POSE_RATES, RATES, pose, street_log, training_data

SHIRT = (0.8, 0.3, 0.1)

BODY_IN_BOX = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""A body's left is the box's y, its up is z, its front is x."""


def walker(
    name: str = "walker",
    frames: tuple[int, ...] = tuple(range(NUM_FRAMES)),
    *,
    valid: tuple[bool, ...] | None = None,
    height: float = 1.6,
    y: float = 0.0,
    seed: int = 0,
    spread: float = 0.4,
) -> Track:
    """Walks 1 m a frame and turns 0.2 rad a frame; all joints turn at random, by about ``spread`` radians."""
    poses = torch.stack([pose(0.2 * frame, (4.0 + frame, y, 0.9)) for frame in frames])
    joints = Rotation.from_rotvec(
        spread * torch.randn(len(frames) * NUM_JOINTS, 3, generator=torch.Generator().manual_seed(seed)).numpy()
    ).as_matrix()
    rotations = torch.from_numpy(joints).reshape(len(frames), NUM_JOINTS, 3, 3)
    rotations[:, 0] = poses[:, :3, :3] @ BODY_IN_BOX
    seen = torch.ones(len(frames), dtype=torch.bool) if valid is None else torch.tensor(valid)
    body = BodyPoses(quat.from_matrix(rotations).float(), seen, torch.zeros(10))
    return Track(name, "Pedestrian", torch.tensor(frames), poses, torch.tensor([0.6, 0.6, height]), body)


def bent(track: Track, joint: str, angles: Tensor) -> Track:
    """The same track, but at rest apart from the root and one joint, which is turned about z by so many radians."""
    rotations = torch.zeros_like(track.body.rotations)
    rotations[..., 0] = 1
    rotations[:, 0] = track.body.rotations[:, 0]
    about_z = torch.zeros(len(angles), 3)
    about_z[:, 2] = angles
    rotations[:, JOINTS.index(joint)] = quat.from_rotation_vector(about_z)
    body = BodyPoses(rotations, track.body.valid, track.body.shape)
    return Track(track.name, track.class_name, track.frames, track.world_from_object, track.size, body)


def smpl_settings(**changes) -> SmplSettings:
    """Bodies of about 500 vertices; no limits, no mask, unless said."""
    said = {
        "classes": ("Pedestrian",),
        "min_gaussians": 0,
        "max_gaussians": None,
        "sh_degree": 1,
        "mask": None,
        "masked": False,
        "density": None,
        "prunable": False,
        "body": BuiltinBody(500),
        "learning_rates": RATES | POSE_RATES | {"joint_deltas": LearningRate(0.001)},
    }
    return SmplSettings(**(said | changes))


def people_log(*tracks: Track, returns: bool = True) -> DrivingLog:
    """The hand-made street with these people; with returns, each sweep has a few in the middle of every box."""
    log = street_log()
    sweeps = []
    for sweep in log.sweeps:
        found = [track.world_from_object[track.frames == sweep.index, :3, 3].float() for track in tracks if returns]
        points = torch.cat([torch.zeros(0, 3), *found])
        colored = torch.ones(len(points), dtype=torch.bool)
        sweeps.append(Sweep(sweep.index, sweep.time, points, torch.tensor(SHIRT).expand(len(points), 3), colored))
    return replace(log, sweeps=Sweeps.of(tuple(sweeps)), tracks=tracks)


def data_of(*tracks: Track, held_out: frozenset[int] = frozenset(), returns: bool = True, **changes) -> TrainingData:
    return training_data(people_log(*tracks, returns=returns), held_out, movers=smpl_settings(**changes))


def smpl(*tracks: Track, held_out: frozenset[int] = frozenset(), **changes) -> Smpl:
    node = smpl_settings(**changes).build(
        data_of(*tracks, held_out=held_out, **changes), torch.Generator().manual_seed(0)
    )
    assert node is not None
    return node
