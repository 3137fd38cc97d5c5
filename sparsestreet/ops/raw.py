"""Gaussians as nodes store them: raw parameters, mask multipliers and the boxes of their instances."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.types import Harmonics

OPACITY_LOGIT_LIMIT = 15.0
"""sigmoid(15) = 1 - 3e-7. Beyond it float32 has no gradient left, and exp could overflow."""
INPUTS, LEARNED = 9, 7
"""Number of the tensors of a part that are activated, and how many of them, the first ones, have gradients."""


@dataclass(frozen=True)
class Poses:
    """World-from-box pose of every instance at one time."""

    quaternions: Float[Tensor, "i 4"]
    """Unit, wxyz."""
    translations: Float[Tensor, "i 3"]
    """Box center in the world, meters."""
    present: Bool[Tensor, " i"]


@dataclass(frozen=True)
class Placement:
    """The instance of each row, and the poses of the instances' boxes."""

    poses: Poses
    instances: Int[Tensor, " n"]


Inputs = tuple[
    Tensor, Tensor, Tensor, Tensor,
    Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None,
]  # fmt: skip
"""A part as backends take it; see :meth:`RawGaussians.tensors`."""


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
    """The coefficients after the first, k in {0, 3, 8, 15}."""
    multipliers: Float[Tensor, " n"] | None = None
    """Factors of opacities and scales, from a mask; None: 1."""
    placement: Placement | None = None
    """Moves means and quaternions from their boxes to the world; rows of an absent instance get opacity 0."""

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> Inputs:
        """Four fields, multipliers, the poses' quaternions and translations, instances and presence, in order."""
        fields = (self.means, self.log_scales, self.quaternions, self.opacity_logits)
        if self.placement is None:
            return *fields, self.multipliers, None, None, None, None
        poses, instances = self.placement.poses, self.placement.instances
        return *fields, self.multipliers, poses.quaternions, poses.translations, instances, poses.present

    def terms(self, sh_degree: int) -> int:
        """Number of coefficients in use up to a degree; rows that store fewer use all of theirs."""
        return min((sh_degree + 1) ** 2, 1 + self.sh_rest.shape[1])


def harmonics_of(parts: Sequence[RawGaussians], sh_degree: int) -> Harmonics:
    """Return the parts' own tables, of which all coefficients up to a degree are in use."""
    terms = max(part.terms(sh_degree) for part in parts)
    return Harmonics(tuple(part.sh_dc for part in parts), tuple(part.sh_rest for part in parts), terms)


def split_parts(tensors: Sequence[Tensor | None]) -> list[tuple[slice, Inputs]]:
    """Return the rows of each part among all, and its inputs; ``tensors``: the inputs of all parts in one row."""
    found, start = [], 0
    for i in range(0, len(tensors), INPUTS):
        part = cast(Inputs, tuple(tensors[i : i + INPUTS]))
        found.append((slice(start, start + len(part[0])), part))
        start += len(part[0])
    return found
