"""From rows as nodes store them to rows as they are splatted: activated, masked, placed in the world, in one table."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.ops.eager import eager
from sparsestreet.ops.fused import fused_backend
from sparsestreet.ops.poses import Poses
from sparsestreet.types import Gaussians

OPACITY_LOGIT_LIMIT = 15.0
"""sigmoid(15) = 1 - 3e-7: beyond it float32 knows no gradient any more, and exp would only gather overflow."""

INPUTS, LEARNED = 11, 9
"""Tensors of a part, and how many of them, the first ones, are of real numbers and have gradients."""


@dataclass(frozen=True)
class Placement:
    """In which instance's box each row lies, and where the boxes are."""

    poses: Poses
    instances: Int[Tensor, " n"]


@dataclass(frozen=True)
class RawGaussians:
    """Gaussians as they are learned, in the world or in the boxes of their instances."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    """wxyz, any non-zero length."""
    opacity_logits: Float[Tensor, " n"]
    sh_dc: Float[Tensor, "n 1 3"]
    sh_rest: Float[Tensor, "n k 3"]
    """The coefficients behind the first, k in {0, 3, 8, 15}."""
    multipliers: Float[Tensor, " n"] | None = None
    """Of opacities and scales (a mask's); None: 1."""
    placement: Placement | None = None
    """Moves means and quaternions from their boxes to the world; rows of an absent instance get opacity 0."""

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> list[Tensor | None]:
        """Six fields, multipliers, the poses' quaternions and translations, and then instances and presence."""
        fields = [self.means, self.log_scales, self.quaternions, self.opacity_logits, self.sh_dc, self.sh_rest]
        if self.placement is None:
            return [*fields, self.multipliers, None, None, None, None]
        poses, instances = self.placement.poses, self.placement.instances
        return [*fields, self.multipliers, poses.quaternions, poses.translations, instances, poses.present]

    def terms(self, sh_degree: int) -> int:
        """Coefficients in use up to a degree; rows that store fewer use what they have."""
        return min((sh_degree + 1) ** 2, 1 + self.sh_rest.shape[1])


@eager
def activate(parts: Sequence[RawGaussians], *, sh_degree: int, backend: str = "auto") -> Gaussians:
    """All parts one after the other: scales exp(s), opacities sigmoid(o) (3DGS), coefficients up to a degree.

    With gradients to all that is learned; a part that uses fewer coefficients than another is padded with zeros. One
    operation of the C++ library and one backward, whatever the number of parts and instances; of Triton a kernel for
    each part; or a few dozen operations of torch for each. But for torch's, which adds up the gradients of poses by
    atomics on a GPU, two runs agree to the last bit.

    ``backend``: "torch", "cpu", "triton" or "auto"; raises as :func:`sparsestreet.ops.fused.fused_backend`.
    """
    numbers = [tensor for part in parts for tensor in part.tensors()[:LEARNED] if tensor is not None]
    chosen = fused_backend(backend, *numbers)
    if chosen == "cpu":
        from sparsestreet.ops.cpu.activate import activate as cpu_activate

        return cpu_activate(parts, sh_degree, OPACITY_LOGIT_LIMIT)
    if chosen == "triton":
        from sparsestreet.ops.triton.activate import activate as triton_activate

        return triton_activate(parts, sh_degree, OPACITY_LOGIT_LIMIT)
    return Gaussians.concatenate([_activated(part, part.terms(sh_degree)) for part in parts])


def _activated(raw: RawGaussians, terms: int) -> Gaussians:
    opacities = torch.sigmoid(raw.opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT))
    scales = torch.exp(raw.log_scales)
    if raw.multipliers is not None:
        opacities, scales = opacities * raw.multipliers, scales * raw.multipliers[:, None]
    sh = torch.cat((raw.sh_dc, raw.sh_rest[:, : terms - 1]), dim=1) if terms > 1 else raw.sh_dc
    if raw.placement is None:
        return Gaussians(raw.means, raw.quaternions, scales, opacities, sh)
    means, quaternions, presence = _placed(raw, raw.placement)
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
