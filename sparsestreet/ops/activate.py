"""From rows as a node stores them to rows as they are splatted: activated, masked, and placed in the world."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.fused import fused_backend
from sparsestreet.ops.poses import Poses
from sparsestreet.types import Gaussians

OPACITY_LOGIT_LIMIT = 15.0
"""sigmoid(15) = 1 - 3e-7: beyond it float32 knows no gradient any more, and exp would only gather overflow."""


@dataclass(frozen=True)
class RawGaussians:
    """Gaussians as they are learned, in the frame of their node or of their instance's box."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    """wxyz, any non-zero length."""
    opacity_logits: Float[Tensor, " n"]
    sh_dc: Float[Tensor, "n 1 3"]
    sh_rest: Float[Tensor, "n k 3"]
    """The coefficients behind the first, k in {0, 3, 8, 15}."""


@dataclass(frozen=True)
class Placement:
    """In which instance's box each row lies, and where the boxes are."""

    poses: Poses
    instances: Int[Tensor, " n"]


def activate(
    raw: RawGaussians,
    *,
    sh_degree: int,
    multipliers: Float[Tensor, " n"] | None = None,
    placement: Placement | None = None,
    backend: str = "auto",
) -> Gaussians:
    """Scales exp(s), opacities sigmoid(o) (3DGS), coefficients up to a degree; with gradients to all that is learned.

    One operation of the C++ library and one backward, or the same in a few dozen of torch.

    Args:
        raw: the stored rows.
        sh_degree: highest degree in use; rows that store fewer coefficients use what they have.
        multipliers: of opacities and scales (a mask's); None: 1.
        placement: moves means and quaternions from their boxes to the world; rows of an absent instance get opacity 0.
        backend: "torch", "cpu" or "auto"; raises as :func:`sparsestreet.ops.fused.fused_backend`.
    """
    terms = min((sh_degree + 1) ** 2, 1 + raw.sh_rest.shape[1])
    if fused_backend(backend, raw.means) == "cpu":
        from sparsestreet.ops.cpu.activate import activate as fused_activate

        return fused_activate(raw, terms, multipliers, placement, OPACITY_LOGIT_LIMIT)
    opacities = torch.sigmoid(raw.opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT))
    scales = torch.exp(raw.log_scales)
    if multipliers is not None:
        opacities, scales = opacities * multipliers, scales * multipliers[:, None]
    sh = torch.cat((raw.sh_dc, raw.sh_rest[:, : terms - 1]), dim=1) if terms > 1 else raw.sh_dc
    if placement is None:
        return Gaussians(raw.means, raw.quaternions, scales, opacities, sh)
    means, quaternions, presence = _placed(raw, placement)
    return Gaussians(means, quaternions, scales, opacities * presence, sh)


def _placed(
    raw: RawGaussians, placement: Placement
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """Means and quaternions in the world, and 1 where the row's instance is present, else 0."""
    poses = placement.poses
    # One table, one gather: rotation matrix (9), quaternion (4), translation (3), presence (1) of each row's box.
    columns = (
        quat.to_matrix(poses.quaternions).flatten(1),
        poses.quaternions,
        poses.translations,
        poses.present[:, None].to(poses.translations),
    )
    row_poses = torch.cat(columns, dim=1).index_select(0, placement.instances)
    rotation, quaternion, translation, presence = row_poses.split((9, 4, 3, 1), dim=1)
    # Written out instead of a matrix product, which autocast would round to bfloat16: meters become decimeters.
    means = (rotation.unflatten(1, (3, 3)) * raw.means[:, None, :]).sum(-1) + translation
    return means, quat.multiply(quaternion, raw.quaternions), presence.squeeze(1)
