"""One learnable keep score per Gaussian, the same at all times."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.masks.straight_through import straight_through


@dataclass(frozen=True)
class StaticMask:
    """Settings of a node's mask; the logits themselves are the column ``mask_logits`` of the node's rows."""

    weight: float
    """lambda_n of the paper: how strongly the node's Gaussians are pushed out."""
    min_gaussians: int
    """K_min of the paper: masks and pruning never leave fewer rows in the node class."""
    threshold: float = 0.01
    """epsilon of the paper (value of Compact-3DGS, whose mask the paper repeats)."""
    initial_logit: float = 1.0
    visible_only: bool = False
    """True: the loss pushes a row only in views that draw it. Adam forgets the size of a gradient, so that with the
    paper's sum over all rows one that few images see is pushed out between two visits, at any lambda; with this one
    lambda is weighed against the image error. Rows that no image sees are then left to background pruning."""

    def __post_init__(self) -> None:
        if not self.weight >= 0:
            raise ValueError(f"a mask's weight must be >= 0, got {self.weight}")
        if not self.min_gaussians >= 0:
            raise ValueError(f"a mask's min_gaussians must be >= 0, got {self.min_gaussians}")
        if not 0 <= self.threshold < 1:
            raise ValueError(f"a mask's threshold of a sigmoid must lie in [0, 1), got {self.threshold}")

    def initial_logits(self, rows: int) -> Float[Tensor, " n"]:
        return torch.full((rows,), self.initial_logit, dtype=torch.float32)

    def scores(self, logits: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """sigma(m), float32 under any precision: in bfloat16 logits stop moving at -4.0, above the threshold."""
        with torch.autocast(logits.device.type, enabled=False):
            return torch.sigmoid(logits.float())

    def multipliers(self, scores: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """M_k in {0, 1} for opacity and scale, with straight-through gradient; re-opens below K_min.

        If fewer than ``min_gaussians`` scores pass the threshold, the highest ones count as passing.
        """
        return straight_through(scores, self.effective_threshold(scores))

    def effective_threshold(self, scores: Float[Tensor, " n"]) -> float:
        """The threshold, lowered where needed so that ``min_gaussians`` (or all) rows pass; ties all pass."""
        rows = scores.shape[0]
        floor = min(self.min_gaussians, rows)
        if floor == 0 or int((scores > self.threshold).sum()) >= floor:
            return self.threshold
        lowest_kept = scores.detach().kthvalue(rows - floor + 1).values
        # One step below the lowest score that must pass, since the comparison is strict.
        return float(torch.nextafter(lowest_kept, torch.full_like(lowest_kept, -1.0)))
