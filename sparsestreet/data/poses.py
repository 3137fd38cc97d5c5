"""Rigid transforms of a data set: made of quaternions, checked, and re-centered in float64."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from sparsestreet.data.problems import Problem, fault
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, rigidity_error

AHEAD_FROM_OPENCV = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""Axes x ahead, y left, z up, which Waymo's cameras have too, from OpenCV's."""
RIGIDITY_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is let through: it moves a point 100 m away by 5 mm, less than lidar noise, and is a
hundred times what poses stored in float32 show."""
_LENGTH_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: one that was stored with four digits is let through, and made 1."""


def rigid_poses(
    quaternions: Float64[Tensor, "n 4"], translations: Float64[Tensor, "n 3"], path: Path, what: str
) -> Float64[Tensor, "n 4 4"]:
    """Transforms of rotations (wxyz) and translations. Raises LogError, naming the file and the first row, for numbers
    that are not finite, and quaternions that are no rotations."""
    broken = ~(torch.isfinite(quaternions).all(-1) & torch.isfinite(translations).all(-1))
    if broken.any():
        row = int(torch.nonzero(broken)[0])
        raise fault(path, f"{what} {row} holds NaN or infinity", "write the pose again, or leave it out")
    lengths = quaternions.norm(dim=-1)
    if ((lengths - 1).abs() > _LENGTH_TOLERANCE).any():
        row = int((lengths - 1).abs().argmax())
        message = f"{what} {row} has a quaternion of length {float(lengths[row]):.4g}, which is no rotation"
        raise fault(path, message, "write unit quaternions, w first")
    poses = torch.zeros(len(quaternions), 4, 4, dtype=torch.float64)
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = quat.to_matrix(quaternions), translations, 1
    return poses


def check_rigid(pose: Float64[Tensor, "4 4"], path: Path, what: str) -> None:
    """Raise LogError unless the matrix is finite and a rotation and translation."""
    if not torch.isfinite(pose).all():
        raise fault(path, f"{what} holds NaN or infinity", "write the pose again, or leave its frame out")
    error = rigidity_error(pose)
    if error > RIGIDITY_TOLERANCE:
        message = f"{what} is no rigid transform: R^T R, det R or the last row is off by {error:.2g}"
        raise fault(path, message, f"write a rotation and a translation in meters, to {RIGIDITY_TOLERANCE:g} or better")


def are_rigid(poses: Float64[Tensor, "n 4 4"]) -> bool:
    """Whether ``check_rigid`` would let all of them through, without a look at each."""
    rotations = poses[:, :3, :3]
    gram = (rotations.mT @ rotations - torch.eye(3, dtype=poses.dtype)).abs()
    last = (poses[:, 3] - torch.tensor([0, 0, 0, 1], dtype=poses.dtype)).abs()
    # A NaN compares false.
    near = bool((gram <= RIGIDITY_TOLERANCE).all() & (last <= RIGIDITY_TOLERANCE).all())
    return near and bool(torch.isfinite(poses).all() & (torch.linalg.det(rotations) > 0).all())


def recentered(pose: Float64[Tensor, "*b 4 4"], origin: Float64[Tensor, "3"]) -> Float64[Tensor, "*b 4 4"]:
    """Poses of a data set's world in the log's, whose origin is at ``origin``; the axes are kept."""
    pose = pose.clone()
    pose[..., :3, 3] -= origin
    return pose


def dataset_from_world(origin: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    """What undoes ``recentered``."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, 3] = origin
    return transform


_POINTS_AT_ONCE = 16_384
"""A pose for each point takes 128 bytes; these stay in the processor's cache."""


@dataclass(frozen=True)
class PosePath:
    """Where a rigid thing is over time: a_from_b at some instants, and between them at constant velocity.

    Raises ValueError for stamps that do not increase, and poses that are not finite or not as many.
    """

    stamps: Int64[Tensor, " n"]
    """Nanoseconds, strictly increasing."""
    poses: Float64[Tensor, "n 4 4"]
    """Rigid transforms a_from_b, such as world_from_vehicle."""
    max_extrapolation: int = 0
    """Nanoseconds before the first stamp and behind the last one up to which the velocity there goes on."""

    def __post_init__(self) -> None:
        if self.stamps.dtype != torch.int64 or self.poses.dtype != torch.float64:
            raise ValueError(
                f"a path has int64 nanoseconds and float64 poses, got {self.stamps.dtype} and {self.poses.dtype}: "
                "convert them before anything is rounded"
            )
        if len(self.stamps) != len(self.poses) or not len(self.stamps):
            raise ValueError(
                "a path needs at least one pose, and a pose for each stamp, got "
                f"{len(self.stamps)} stamps and {len(self.poses)} poses"
            )
        late = torch.nonzero(self.stamps[1:] <= self.stamps[:-1]).flatten()
        if len(late):
            place = int(late[0]) + 1
            raise ValueError(
                f"stamps must increase, but {int(self.stamps[place])} follows {int(self.stamps[place - 1])} at place "
                f"{place}: sort the poses by their stamps and keep one of each"
            )
        broken = torch.nonzero(~torch.isfinite(self.poses).flatten(1).all(1)).flatten()
        if len(broken):
            raise ValueError(f"pose {int(broken[0])} holds NaN or infinity: leave it out")

    def at(self, stamps: Int64[Tensor, " k"]) -> Float64[Tensor, "k 4 4"]:
        """Poses at some instants: translations on a line between two poses, rotations on the shorter arc (slerp).

        Raises ValueError for instants that lie farther outside than ``max_extrapolation``.

        >>> poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        >>> poses[1, 0, 3] = 8.0
        >>> PosePath(torch.tensor([0, 100]), poses).at(torch.tensor([25]))[0, 0, 3]
        tensor(2., dtype=torch.float64)
        """
        self._check_within(stamps)
        if len(self.stamps) == 1:
            return self.poses.expand(len(stamps), 4, 4).clone()
        lower = (torch.searchsorted(self.stamps, stamps, right=True) - 1).clamp(0, len(self.stamps) - 2)
        # Integers are subtracted before anything is rounded.
        since, step = stamps - self.stamps[lower], self.stamps[lower + 1] - self.stamps[lower]
        fraction = (since.double() / step.double())[:, None]
        rotations, turns = self._turns
        poses = torch.zeros(len(stamps), 4, 4, dtype=torch.float64)
        turned = quat.from_rotation_vector(fraction * turns[lower])
        poses[:, :3, :3] = quat.to_matrix(quat.multiply(rotations[lower], turned))
        poses[:, :3, 3] = torch.lerp(self.poses[lower, :3, 3], self.poses[lower + 1, :3, 3], fraction)
        poses[:, 3, 3] = 1
        return poses

    def motion_during(self, stamp: int, duration: int) -> tuple[Float32[Tensor, "3"], Float32[Tensor, "3"]]:
        """Translation, and rotation vector, over ``duration`` nanoseconds around an instant, in the frame b of then.

        Those of ``Shutter`` for a path of a camera, with the middle of the readout and its length. Raises as ``at``.
        """
        begin = stamp - duration // 2
        start, middle, end = self.at(torch.tensor([begin, stamp, begin + duration]))
        translation = middle[:3, :3].T @ (end[:3, 3] - start[:3, 3])
        turn = end[:3, :3] @ start[:3, :3].T
        rotation = quat.to_rotation_vector(quat.from_matrix(middle[:3, :3].T @ turn @ middle[:3, :3]))
        return translation.float(), rotation.float()

    @cached_property
    def _turns(self) -> tuple[Float64[Tensor, "n 4"], Float64[Tensor, "_ 3"]]:
        """Each rotation, and the rotation vector from it to the next."""
        rotations = quat.from_matrix(self.poses[:, :3, :3])
        back = rotations[:-1] * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
        return rotations, quat.to_rotation_vector(quat.multiply(back, rotations[1:]))

    def _check_within(self, stamps: Int64[Tensor, " k"]) -> None:
        beyond = torch.maximum(self.stamps[0] - stamps, stamps - self.stamps[-1])
        outside = beyond > self.max_extrapolation
        if outside.any():
            raise ValueError(
                f"{int(outside.sum())} of {len(stamps)} instants lie up to {int(beyond.max())} ns outside of the poses "
                f"from {int(self.stamps[0])} to {int(self.stamps[-1])}, more than {self.max_extrapolation} ns: leave "
                "out what was measured then, or allow it by max_extrapolation"
            )


def untwisted(
    points: Float[Tensor, "n 3"], stamps: Int64[Tensor, " n"], path: PosePath, at: int | None = None
) -> Float64[Tensor, "n 3"]:
    """Points that were measured at their own instants, where the street was at one: the sensor's motion taken out.

    Args:
        points: in the frame b of the path, such as the sensor's or the vehicle's, each at its own instant; meters.
        stamps: nanoseconds at which each point was measured.
        path: a_from_b over the time of the sweep.
        at: None: the result is in frame a, mostly the world; else in frame b as it stands at this instant.

    Raises ValueError as ``PosePath.at``, and for another number of stamps than points.
    """
    if len(points) != len(stamps):
        raise ValueError(f"a sweep needs a stamp for each point, got {len(points)} points and {len(stamps)} stamps")
    back = None if at is None else inverse(path.at(torch.tensor([at]))[0])
    moved = torch.empty(len(points), 3, dtype=torch.float64)
    for start in range(0, len(points), _POINTS_AT_ONCE):
        some = slice(start, start + _POINTS_AT_ONCE)
        poses = path.at(stamps[some])
        poses = poses if back is None else back @ poses
        moved[some] = torch.einsum("nij,nj->ni", poses[:, :3, :3], points[some].double()) + poses[:, :3, 3]
    return moved


MAX_SCENE = 20_000.0
"""Meters. Re-centered coordinates of up to this are exact to 1 mm in float32 (spacing 2^-9 m beyond 16 km, rounded)."""


def check_extent(placed: Sequence[tuple[Path, Float64[Tensor, "3"]]]) -> list[Problem]:
    """A problem where positions of poses and boxes, in one world, lie too far apart; it names the file of the farthest.

    Args:
        placed: the file that each position is from, and the position, meters.
    """
    if not placed:
        return []
    positions = torch.stack([position for _, position in placed])
    extent = float((positions.amax(0) - positions.amin(0)).max())
    if extent <= MAX_SCENE:
        return []
    strayed = int((positions - positions.median(0).values).norm(dim=-1).argmax())
    message = f"poses span {extent / 1000:.1f} km, more than the {MAX_SCENE / 1000:g} km that float32 can hold"
    remedy = "repair this pose, the farthest from the others, or read fewer frames (data.log.first_frame, .last_frame)"
    return [Problem(placed[strayed][0], message, remedy)]
