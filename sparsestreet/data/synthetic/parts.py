"""A part is a convex solid with a surface, placed in the frame of an object or of the world."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.synthetic.shapes import Capsule, Shape
from sparsestreet.data.synthetic.textures.appearance import Surface

BACKGROUND = -1
"""Object index of parts that belong to no annotated object."""

Pose = Float64[np.ndarray, "4 4"]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    shape: Shape
    surface: Surface
    frame_from_part: Pose
    """The frame is the object's while a model is built, and the world once the part stands in the street."""
    object_index: int = BACKGROUND


def placed(parts: list[Part], world_from_object: Pose, object_index: int = BACKGROUND) -> list[Part]:
    """Returns the parts of an object, moved to the world."""
    return [
        replace(part, frame_from_part=world_from_object @ part.frame_from_part, object_index=object_index)
        for part in parts
    ]


def at(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """Returns a pose at a position, turned by ``yaw`` radians about z.

    >>> at(1.0, 2.0, 0.0)[:3, 3].tolist()
    [1.0, 2.0, 0.0]
    """
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return pose


def axis_along_y(x: float, y: float, z: float) -> Pose:
    """Returns a pose whose z axis is the frame's y axis, as for wheels on an axle."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    pose[:3, 3] = x, y, z
    return pose


def limb(start: Point, end: Point, radius: float, surface: Surface) -> Part:
    """Returns a capsule whose axis runs from one point to another, meters."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((np.cross(side, axis), side, axis), axis=1)
    pose[:3, 3] = (a + b) / 2
    return Part(Capsule(radius, length / 2.0), surface, pose)
