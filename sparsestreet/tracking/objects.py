"""What is found: kinds of objects, what they measure where nobody saw it, and their boxes."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64, Int64

Kind = Literal["vehicle", "cyclist", "pedestrian"]

USUAL_SIZES: dict[Kind, tuple[float, float, float]] = {
    "vehicle": (4.3, 1.75, 1.55),
    "cyclist": (1.75, 0.65, 1.75),
    "pedestrian": (0.85, 0.65, 1.7),
}
"""Length, width, height, meters, of what was not seen whole."""


@dataclass(frozen=True)
class FoundObject:
    """One thing that moves, with a box at every frame from its first to its last.

    Raises ValueError for arrays of other lengths, frames that do not increase, and sizes that are not positive.
    """

    kind: Kind
    frames: Int64[np.ndarray, " f"]
    """Increasing."""
    world_from_object: Float64[np.ndarray, "f 4 4"]
    """x along the length (heading), y left, z up; the origin is the middle of the box."""
    size: Float64[np.ndarray, "3"]
    """Length, width, height, meters."""
    size_unsure: Float64[np.ndarray, "3"]
    """Meters by which each may be off; large for a length that nobody saw."""
    returns: Int64[np.ndarray, " f"]
    """Number of returns that a frame's box was found by; 0: it is interpolated, or carried while the object stands."""
    confidence: float
    """In [0, 1]."""

    def __post_init__(self) -> None:
        lengths = {len(self.frames), len(self.world_from_object), len(self.returns)}
        if len(lengths) != 1 or not len(self.frames):
            raise ValueError(f"a found object needs a pose and a count for each frame, got {sorted(lengths)} of them")
        if (np.diff(self.frames) <= 0).any():
            raise ValueError(f"the frames of a found object must increase, got {self.frames.tolist()}: sort them")
        if not (np.isfinite(self.size) & (self.size > 0)).all():
            raise ValueError(f"the size of a found object must be positive, got {self.size.tolist()}")
        if self.kind not in get_args(Kind) or not 0 <= self.confidence <= 1:
            kinds = ", ".join(get_args(Kind))
            raise ValueError(
                f"a found object is one of {kinds} with a confidence in [0, 1], got {self.kind} and {self.confidence}"
            )

    @property
    def path_length(self) -> float:
        """Length of the path of the box's middle, meters."""
        return float(np.linalg.norm(np.diff(self.world_from_object[:, :3, 3], axis=0), axis=1).sum())


def upright_poses(middle: Float64[np.ndarray, "f 3"], yaw: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, "f 4 4"]:
    """Return world_from_object of boxes that stand upright; ``yaw`` in radians from the world's x to its y."""
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, :3, 3] = middle
    return poses
