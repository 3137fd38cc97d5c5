"""The shape of a human body: a capsule around each bone of ``skeleton``."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sparsestreet.geometry.skeleton import JOINTS, NUM_JOINTS, rest_joints

_BLEND = 0.01
"""Meters over which two capsules blend into each other."""
_MAX_JOINTS = 4
"""Largest number of joints that move one vertex, as in SMPL."""
_FALLOFF = 4
"""Power of the distance by which a bone's weight falls off."""

_MIDDLE = (
    # The joint that moves the capsule, its two ends (x, y, z in meters at rest; a name is a joint), its radius.
    ("pelvis", (-0.06, 0.93, 0.0), (0.06, 0.93, 0.0), 0.12),
    ("spine1", "spine1", "spine2", 0.125),
    ("spine2", "spine2", "spine3", 0.13),
    ("spine3", (-0.09, 1.30, 0.0), (0.09, 1.30, 0.0), 0.11),
    ("neck", (0.0, 1.36, 0.0), "head", 0.06),
    ("head", (0.0, 1.59, 0.02), (0.0, 1.655, 0.015), 0.095),
)
_LEFT = (
    ("left_hip", "left_hip", "left_knee", 0.07),
    ("left_knee", "left_knee", "left_ankle", 0.056),
    ("left_ankle", (0.085, 0.055, -0.02), (0.085, 0.055, 0.1), 0.048),
    ("left_foot", (0.085, 0.05, 0.12), (0.085, 0.05, 0.15), 0.045),
    ("left_collar", "left_collar", "left_shoulder", 0.07),
    ("left_shoulder", "left_shoulder", "left_elbow", 0.052),
    ("left_elbow", "left_elbow", "left_wrist", 0.045),
    ("left_wrist", "left_wrist", "left_hand", 0.045),
    ("left_hand", "left_hand", (0.85, 1.36, 0.0), 0.045),
)


@dataclass(frozen=True)
class Capsules:
    """Capsules of a body at rest, in the frame of its joints, meters."""

    joints: Int64[np.ndarray, " c"]
    starts: Float64[np.ndarray, "c 3"]
    ends: Float64[np.ndarray, "c 3"]
    radii: Float64[np.ndarray, " c"]

    @staticmethod
    def of_body() -> "Capsules":
        places = dict(zip(JOINTS, rest_joints().double().numpy(), strict=True))
        rows = []
        for joint, start, end, radius in (*_MIDDLE, *_LEFT):
            ends = [places[end] if isinstance(end, str) else np.array(end) for end in (start, end)]
            rows.append((JOINTS.index(joint), *ends, radius))
            if joint.startswith("left"):
                mirrored = [end * (-1, 1, 1) for end in ends]
                rows.append((JOINTS.index(joint.replace("left", "right")), *mirrored, radius))
        joints, starts, ends, radii = (np.array(column) for column in zip(*rows, strict=True))
        return Capsules(joints, starts, ends, radii)

    def distances(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return signed distances from the surface, meters, negative inside; exact far from where capsules meet."""
        each = self._from_axes(points) - self.radii
        nearest = each.min(1, keepdims=True)
        return nearest[:, 0] - _BLEND * np.log(np.exp((nearest - each) / _BLEND).sum(1))

    def weights(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 24"]:
        """Return weights by the inverse distance from each bone's axis, in radii, to a power."""
        hold = (self.radii / self._from_axes(points)) ** _FALLOFF
        weights = np.zeros((len(points), NUM_JOINTS))
        for joint, column in zip(self.joints, hold.T, strict=True):
            weights[:, joint] += column
        weakest = np.sort(weights, 1)[:, -_MAX_JOINTS - 1, None]
        # Subtract the strongest weight that is left out: a joint then has weight 0 where another takes its place.
        kept = np.clip(weights - weakest, 0, None)
        return kept / kept.sum(1, keepdims=True)

    def _from_axes(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n c"]:
        axes = self.ends - self.starts
        to_points = points[:, None] - self.starts
        along = np.clip((to_points * axes).sum(2) / (axes * axes).sum(1), 0, 1)
        return np.linalg.norm(to_points - along[..., None] * axes, axis=2)
