"""Turns rows as nodes store them into Gaussians to splat: activated, masked, placed in the world, in one table."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.backend import disable_compile, fused_backend
from sparsestreet.ops.raw import LEARNED, OPACITY_LOGIT_LIMIT, Placement, RawGaussians, harmonics_of
from sparsestreet.types import Gaussians


@disable_compile
def activate(parts: Sequence[RawGaussians], *, sh_degree: int, backend: str = "auto") -> Gaussians:
    """Activates all parts into one table: scales exp(s), opacities sigmoid(o) (3DGS). Harmonics stay in the parts' own.

    Gradients go to everything that is learned. The C++ library needs one operation and one backward for all parts and
    instances. Triton runs one kernel per part, torch a few dozen operations. Two runs agree to the last bit, except
    with torch on a GPU, which sums the gradients of poses by atomics.

    ``backend``: "torch", "cpu", "triton" or "auto"; raises as :func:`sparsestreet.ops.backend.fused_backend`.
    """
    numbers = [tensor for part in parts for tensor in part.tensors()[:LEARNED] if tensor is not None]
    chosen = fused_backend(backend, *numbers)
    if chosen == "cpu":
        from sparsestreet.ops.cpu.rows import activate as activated
    elif chosen == "triton":
        from sparsestreet.ops.triton.activate import activate as activated
    else:
        activated = _activate
    sh = harmonics_of(parts, sh_degree)
    return Gaussians.of_learned((*activated(parts), *sh.tables), sh.terms)


def _activate(parts: Sequence[RawGaussians]) -> Sequence[Tensor]:
    columns = zip(*map(_activated, parts), strict=True)
    return [torch.cat(column) if len(parts) > 1 else column[0] for column in columns]


def _activated(raw: RawGaussians) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    opacities = torch.sigmoid(raw.opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT))
    scales = torch.exp(raw.log_scales)
    if raw.multipliers is not None:
        opacities, scales = opacities * raw.multipliers, scales * raw.multipliers[:, None]
    if raw.placement is None:
        return raw.means, raw.quaternions, scales, opacities
    means, quaternions, presence = _placed(raw, raw.placement)
    return means, quaternions, scales, opacities * presence


def _placed(
    raw: RawGaussians, placement: Placement
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """Means and quaternions in the world, and 1 where the row's instance is present, else 0."""
    poses = placement.poses
    # One gather from one table: rotation matrix (9), quaternion (4), translation (3), presence (1) of each row's box.
    columns = (
        quat.to_matrix(poses.quaternions).flatten(1),
        poses.quaternions,
        poses.translations,
        poses.present[:, None].to(poses.translations),
    )
    row_poses = torch.cat(columns, dim=1).index_select(0, placement.instances)
    rotation, quaternion, translation, presence = row_poses.split((9, 4, 3, 1), dim=1)
    # Not a matrix product, which autocast would round to bfloat16: that loses decimeters.
    means = (rotation.unflatten(1, (3, 3)) * raw.means[:, None, :]).sum(-1) + translation
    return means, quat.multiply(quaternion, raw.quaternions), presence.squeeze(1)
