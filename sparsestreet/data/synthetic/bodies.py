"""Body poses of the street's pedestrians, in the format in which DriveStudio keeps estimated poses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sparsestreet.data.drivestudio.bodies import blank_person, pickled_people, set_pose
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
        stored = self._people.setdefault(key, blank_person(self.settings.num_frames))
        set_pose(stored, frame.index, rotations, camera)

    def write(self, path: Path) -> None:
        """Writes the file if anybody was seen."""
        if self._people:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickled_people(self._people))
