"""Poses of moving objects at a time, interpolated between keyframes with learned corrections."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.trajectories import Trajectories, keyframe_interval
from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.raw import Poses


def poses_at(
    keyframes: Trajectories,
    rotation_deltas: Float[Tensor, "i k 3"],
    translation_deltas: Float[Tensor, "i k 3"],
    time: float,
    max_gap: float,
    *,
    backend: str = "auto",
) -> Poses:
    """Interpolates the pose of each instance at a time; gradients go to the corrections.

    A corrected keyframe has the rotation R exp([rotation_delta]) (a rotation vector in the box frame, radians) and the
    translation t + translation_delta (world, meters). ``keyframe_interval`` chooses two keyframes per instance and says
    which instances are present. The translation is interpolated linearly, the rotation by slerp along the shorter arc.

    The C++ library and Triton need one operation for all instances, forward and backward; torch needs dozens.
    ``backend``: "torch", "cpu", "triton" or "auto"; raises as :func:`sparsestreet.ops.backend.fused_backend` does.
    """
    table = keyframes
    numbers = (table.times, table.quaternions, table.translations, table.spans, rotation_deltas, translation_deltas)
    chosen = fused_backend(backend, *numbers)
    if chosen == "cpu":
        from sparsestreet.ops.cpu.rows import poses_at as cpu_poses

        return Poses(*cpu_poses(table, rotation_deltas, translation_deltas, time, max_gap))
    if chosen == "triton":
        from sparsestreet.ops.triton.poses import poses_at as triton_poses

        return Poses(*triton_poses(table, rotation_deltas, translation_deltas, time, max_gap))
    at = keyframe_interval(table.times, table.valid, table.spans, time, max_gap)
    lower, upper = (_corrected(table, rotation_deltas, translation_deltas, place) for place in (at.lower, at.upper))
    quaternions = quat.slerp(lower[0], upper[0], at.fraction)
    return Poses(quaternions, torch.lerp(lower[1], upper[1], at.fraction[:, None]), at.active)


def _corrected(
    table: Trajectories,
    rotation_deltas: Float[Tensor, "i k 3"],
    translation_deltas: Float[Tensor, "i k 3"],
    keyframes: Int[Tensor, " i"],
) -> tuple[Float[Tensor, "i 4"], Float[Tensor, "i 3"]]:
    """Corrected pose of one keyframe per instance."""
    each = torch.arange(keyframes.shape[0], device=keyframes.device)
    correction = quat.from_rotation_vector(rotation_deltas[each, keyframes])
    quaternions = quat.multiply(table.quaternions[each, keyframes], correction)
    return quaternions, table.translations[each, keyframes] + translation_deltas[each, keyframes]
