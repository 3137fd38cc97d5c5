"""The parts of one instant as arrays, and the parts that a bundle of rays may meet."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int

from sparsestreet.data.synthetic.parts import Part
from sparsestreet.data.synthetic.shapes import Vectors, rotated

_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_MARGIN = np.float32(5e-3)
"""Slack of all culling tests, meters: float32 rounds 250 m by 1.5e-5, and products of three such terms by less."""


@dataclass(frozen=True)
class Scene:
    parts: tuple[Part, ...]
    rotations: Float32[np.ndarray, "p 3 3"]
    """World from part."""
    centers: Float32[np.ndarray, "p 3"]
    half_extents: Float32[np.ndarray, "p 3"]
    corners: Float32[np.ndarray, "p 8 3"]
    """Corners of the bounding boxes, world frame."""
    half_axes: Float32[np.ndarray, "p 3 3"]
    """Columns are vectors from the center of each bounding box to the middle of its faces, world frame, meters."""
    object_indices: Int[np.ndarray, " p"]

    @staticmethod
    def of(parts: list[Part]) -> "Scene":
        poses = np.stack([part.frame_from_part for part in parts])
        half = np.stack([part.shape.half_extent for part in parts]).astype(np.float32)
        rotations = np.ascontiguousarray(poses[:, :3, :3], np.float32)
        centers = np.ascontiguousarray(poses[:, :3, 3], np.float32)
        corners = centers[:, None] + (_SIGNS * half[:, None]) @ rotations.transpose(0, 2, 1)
        objects = np.array([part.object_index for part in parts], np.int16)
        return Scene(tuple(parts), rotations, centers, half, corners, rotations * half[:, None], objects)

    def to_part(self, index: int, points: Float32[np.ndarray, "3 m"]) -> Float32[np.ndarray, "3 m"]:
        """Returns world points in the frame of a part."""
        return rotated(self.rotations[index].T, points - self.centers[index][:, None])

    def turn_to_part(self, index: int, directions: Vectors) -> Vectors:
        return rotated(self.rotations[index].T, directions)

    def turn_to_world(self, index: int, directions: Vectors) -> Vectors:
        return rotated(self.rotations[index], directions)

    def distances(self, origin: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, " p"]:
        """Returns a lower bound of the distance from a point to each part, meters."""
        local = np.einsum("pji,pj->pi", self.rotations, origin - self.centers)
        return np.linalg.norm(np.maximum(np.abs(local) - self.half_extents, 0), axis=1)

    def in_bundle(
        self, among: Int[np.ndarray, " c"], origin: Float32[np.ndarray, "3"], planes: Float32[np.ndarray, "k 3"]
    ) -> Int[np.ndarray, " d"]:
        """Returns the parts that lie wholly outside none of the planes through ``origin`` (normals point inwards)."""
        # The support function of a box is the reach of its farthest corner along each normal.
        reach = np.abs(planes @ self.half_axes[among]).sum(2)
        heights = (self.centers[among] - origin) @ planes.T + reach
        return among[(heights >= -_MARGIN).all(1)]


@dataclass(frozen=True)
class SunView:
    """The scene as the sun sees it, projected to a plane in which every shadow ray is a point."""

    sun: Float32[np.ndarray, "3"]
    axes: Float32[np.ndarray, "3 3"]
    """Rows are two axes across the sunlight, and the direction towards the sun."""
    low: Float32[np.ndarray, "p 3"]
    high: Float32[np.ndarray, "p 3"]

    @staticmethod
    def of(scene: Scene, sun: Float32[np.ndarray, "3"]) -> "SunView":
        side = np.cross(sun, np.array([0, 0, 1], np.float32))
        side /= np.linalg.norm(side)
        axes = np.stack((side, np.cross(sun, side), sun)).astype(np.float32)
        seen = scene.corners @ axes.T
        return SunView(sun, axes, seen.min(1) - _MARGIN, seen.max(1) + _MARGIN)

    def blockers(self, seen: Vectors) -> Int[np.ndarray, " c"]:
        """Returns parts that may lie between the sun and some of the points, which are in this view's coordinates."""
        low, high = seen.min(1), seen.max(1)
        beside = (self.low[:, :2] > high[:2]) | (self.high[:, :2] < low[:2])
        return np.flatnonzero(~beside.any(1) & (self.high[:, 2] > low[2]))
