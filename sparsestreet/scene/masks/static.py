"""One learnable keep score per Gaussian, the same at all times (the paper's mask of static and rigid nodes)."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.masks.mask import Mask, MaskScope, check_mask

COLUMN = "mask_logits"


@dataclass(frozen=True)
class StaticMaskSettings:
    """Settings of a static mask. Raises ValueError for a negative weight or a threshold outside [0, 1)."""

    sparsity_weight: float
    """lambda_n of the paper: how strongly the sparsity loss lowers the scores of the node's Gaussians."""
    threshold: float = 0.01
    """epsilon of the paper (the value of Compact-3DGS, whose mask the paper uses)."""
    initial_logit: float = 1.0
    visible_only: bool = False
    """True: the loss lowers a row's score only in views that draw the row. The paper sums over all rows. But Adam
    ignores the size of a gradient, so this sum closes rows that few images show between two visits, at any lambda. With
    visible rows only, lambda is weighed against the image error. Rows that no image shows are then left to pruning."""

    def __post_init__(self) -> None:
        check_mask(self.sparsity_weight, self.threshold)

    def build(self, min_gaussians: int, scope: MaskScope | None = None) -> "StaticMask":
        """Return the mask; ``scope`` has no effect, because the mask is the same at all times."""
        return StaticMask(self, min_gaussians)


class LogitMask(Mask):
    """A mask with one logit a row, m, for all times; nothing of it remains after training."""

    settings: Any
    """With ``initial_logit`` and ``sparsity_weight``."""
    columns = (COLUMN,)

    def __init__(self, settings: Any, min_gaussians: int = 0) -> None:
        super().__init__()
        self.settings = settings
        self.min_gaussians = min_gaussians
        self.sparsity_weight = settings.sparsity_weight

    def initial_columns(self, num_rows: int) -> dict[str, Tensor]:
        return {COLUMN: torch.full((num_rows,), self.settings.initial_logit, dtype=torch.float32)}

    def scores(self, rows: Rows) -> Float[Tensor, " n"]:
        """Return sigma(m) as float32, because bfloat16 logits stop moving at -4.0, above the threshold."""
        with torch.autocast(rows.mask_logits.device.type, enabled=False):
            return torch.sigmoid(rows.mask_logits.float())

    def finish(self, rows: Rows) -> tuple[None, dict[str, Tensor]]:
        """Return no mask: M = 1 for all rows that stayed."""
        return None, {}


class StaticMask(LogitMask):
    """sigma(m_k) > epsilon, with the logits m as the column ``mask_logits``.

    >>> mask = StaticMaskSettings(sparsity_weight=0.01, threshold=0.5).build(min_gaussians=0)
    >>> rows = Rows({"mask_logits": torch.tensor([2.0, -2.0])})
    >>> mask.multipliers(rows, time=0.0).tolist(), mask.keep(rows).removed
    ([1.0, 0.0], 1)
    """

    settings: StaticMaskSettings

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        """Return M; if fewer than K_min scores pass the threshold, the highest ones count as passing."""
        scores = self.scores(rows)
        return straight_through(scores, self._effective_threshold(scores.detach()))

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        scores = self.scores(rows)
        return (scores * visible if self.settings.visible_only else scores).sum()

    def keep(self, rows: Rows) -> Selection:
        # Compare in the scores' own dtype, as the multipliers do: both must close the same rows.
        scores = self.scores(rows).detach()
        return keep_best(scores, scores <= self.settings.threshold, self.min_gaussians)

    def _effective_threshold(self, scores: Float[Tensor, " n"]) -> float | Float[Tensor, ""]:
        """Return the threshold, lowered if needed so that K_min (or all) rows pass; ties all pass."""
        threshold, floor = self.settings.threshold, min(self.min_gaussians, len(scores))
        if floor == 0:
            return threshold
        # A look at the number of rows that pass saves the sort, but would wait for a GPU.
        if scores.device.type == "cpu" and int((scores > threshold).sum()) >= floor:
            return threshold
        lowered, fires = lowered_threshold(scores, threshold, floor)
        self.floor_firings = self.floor_firings + fires
        return lowered


def lowered_threshold(
    scores: Float[Tensor, " n"], threshold: float, floor: int
) -> tuple[Float[Tensor, ""], Bool[Tensor, ""]]:
    """The threshold, lowered if needed so that ``floor`` of the scores, 1 to n, pass; and whether it is lower.

    Never waits for a GPU.

    >>> scores = torch.tensor([0.5, 0.25, 0.75])
    >>> [float(lowered_threshold(scores, 0.6, floor)[0]) < 0.25 for floor in (1, 2, 3)]
    [False, False, True]
    """
    lowest_kept = scores.topk(floor, sorted=False).values.amin()
    # One step below the lowest score that must pass, since the comparison is strict.
    lowered = torch.nextafter(lowest_kept, torch.full_like(lowest_kept, -1.0))
    return lowered.clamp(max=threshold), lowest_kept <= threshold


def straight_through(scores: Float[Tensor, " n"], threshold: float | Float[Tensor, ""]) -> Float[Tensor, " n"]:
    """Return 1[score > threshold] forward, d/dscore = 1 backward (the paper's M_k; Bengio et al. 2013).

    Scores are sigmoids already, so this applies none.

    >>> scores = torch.tensor([0.25, 0.75], requires_grad=True)
    >>> straight_through(scores, 0.5).tolist()
    [0.0, 1.0]
    """
    # score - score.detach() is exactly 0, so the product with a closed mask is exactly 0 in every dtype.
    hard = (scores > threshold).to(scores.dtype)
    return hard + (scores - scores.detach())
