"""Body poses of the street's pedestrians, in the format in which DriveStudio keeps estimated poses."""

import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sparsestreet.data.synthetic.models.people import Pedestrian
from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.parts import Point
from sparsestreet.data.synthetic.render import StreetFrame
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import World
from sparsestreet.geometry.skeleton import JOINTS, NUM_JOINTS, rest_joints

_BOX_FROM_BODY = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Columns are a body's x (left), y (up), z (forward) in box axes (x forward, y left, z up)."""
_TOE = (0.13, 0.0, -0.01)
"""Vector from the foot of a pedestrian to its toe, in the box frame, meters."""


def joint_rotations(person: Pedestrian, traveled: float) -> Float64[np.ndarray, "24 3 3"]:
    """Returns the rotations of the joints after ``traveled`` meters: box_from_body, then each relative to its parent.

    Limbs point in the directions of the rendered person's limbs, by the shortest turn. The trunk and the hands are at
    rest.
    """
    rotations = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    rotations[0] = _BOX_FROM_BODY
    for side, name in ((1, "left"), (-1, "right")):
        hip, knee, foot = person.leg(side, traveled)
        toe = (foot[0] + _TOE[0], foot[1] + _TOE[1], foot[2] + _TOE[2])
        _point(rotations, [f"{name}_{joint}" for joint in ("hip", "knee", "ankle", "foot")], (hip, knee, foot, toe))
        _point(rotations, [f"{name}_{joint}" for joint in ("shoulder", "elbow", "wrist")], person.arm(side, traveled))
    return rotations


def _point(rotations: Float64[np.ndarray, "24 3 3"], chain: list[str], places: tuple[Point, ...]) -> None:
    """Turns the joints of a chain with its root at rest, so that the limbs point along ``places``."""
    joints = [JOINTS.index(name) for name in chain]
    bones = np.diff(rest_joints().double().numpy()[joints], axis=0)
    wanted = np.diff(np.array(places), axis=0) @ _BOX_FROM_BODY
    turned = np.eye(3)
    for joint, bone, direction in zip(joints, bones, wanted, strict=False):
        rotations[joint] = _shortest_turn(bone, turned.T @ direction)
        turned = turned @ rotations[joint]


def _shortest_turn(start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Returns the rotation by less than half a turn that takes one direction to another."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, a @ b)
    return Rotation.from_rotvec(axis * (angle / sine if sine > 0 else 1.0)).as_matrix()


@dataclass
class BodyWriter:
    """Collects the poses of annotated pedestrians with noise, from the camera that sees most of each person."""

    settings: StreetSettings
    world: World
    min_pixels: int
    """A person has a pose in a frame only if a camera sees it with at least this many pixels."""
    _people: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Instance id -> its data under DriveStudio's names."""

    def record(self, key: int, actor: int, frame: StreetFrame) -> None:
        """Records the pose of an actor in a frame if it is a visible pedestrian; ``key`` is its instance id."""
        person = self.world.actors[actor]
        pixels = [np.count_nonzero(image.object_indices == actor) for image in frame.images]
        camera = int(np.argmax(pixels))
        if not isinstance(person.model, Pedestrian) or pixels[camera] < self.min_pixels:
            return
        rotations = joint_rotations(person.model, person.path.traveled(frame.index / self.settings.frame_rate))
        rng = stream(self.settings.seed, f"body of {person.name} {frame.index}")
        # The setting is the root mean square of the angle, which is the length of three components.
        spread = np.radians(self.settings.body_pose_noise) / np.sqrt(3)
        rotations = rotations @ Rotation.from_rotvec(spread * rng.standard_normal((NUM_JOINTS, 3))).as_matrix()
        world_from_camera = frame.images[camera].camera.world_from_camera[:3, :3]
        rotations[0] = world_from_camera.T @ frame.actor_poses[actor][:3, :3] @ rotations[0]
        stored = self._people.setdefault(key, _nobody(self.settings.num_frames))
        stored["smpl"]["global_orient"][frame.index] = rotations[:1]
        stored["smpl"]["body_pose"][frame.index] = rotations[1:]
        stored["selected_cam_idx"][frame.index] = camera
        for mask in ("matched_mask", "must_appear_mask", "valid_mask"):
            stored[mask][frame.index] = True

    def write(self, path: Path) -> None:
        """Writes the file if anybody was seen. It holds NumPy arrays; DriveStudio's own files hold torch tensors."""
        if self._people:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(self._people, protocol=4))


def _nobody(num_frames: int) -> dict[str, Any]:
    rotations = np.tile(np.eye(3, dtype=np.float32), (num_frames, NUM_JOINTS, 1, 1))
    masks = {mask: np.zeros(num_frames, bool) for mask in ("matched_mask", "must_appear_mask", "valid_mask")}
    smpl = {
        "global_orient": rotations[:, :1].copy(),
        "body_pose": rotations[:, 1:].copy(),
        "betas": np.zeros((num_frames, 10), np.float32),
    }
    return {"smpl": smpl, "selected_cam_idx": np.full(num_frames, -1, np.int64), **masks}
