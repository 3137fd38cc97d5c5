"""A mask of one's own: settings that build it, and what differs from the mask that is there."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.masks import MaskScope, StaticMask, StaticMaskSettings


@dataclass(frozen=True)
class ProbitMaskSettings(StaticMaskSettings):
    """The options of the static mask, for another curve between logit and score."""

    def build(self, min_gaussians: int, scope: MaskScope) -> "ProbitMask":
        return ProbitMask(self, min_gaussians)


class ProbitMask(StaticMask):
    """The score is the normal distribution of the logit: it reaches the threshold in half the way of a sigmoid."""

    def scores(self, rows: Rows) -> Float[Tensor, " n"]:
        return torch.special.ndtr(rows.mask_logits)
