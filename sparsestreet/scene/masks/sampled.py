"""A probability of existence per Gaussian, sampled in every step (MaskGaussian, Liu et al., CVPR 2025)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.generators import named_seed
from sparsestreet.scene.masks.mask import MaskScope, check_mask
from sparsestreet.scene.masks.static import LogitMask, lowered_threshold, straight_through

_LIKELIER = 0.5
"""A softmax of two picks the first above it."""


@dataclass(frozen=True)
class SampledMaskSettings:
    """Settings of a sampled mask. Raises ValueError for a negative weight, or what is not positive and must be."""

    sparsity_weight: float
    """lambda of the paper, times the loss's own weight: how strongly the mean of the samples is lowered."""
    initial_logit: float = 3.0
    """Of all rows at the start: the paper does not say its own. 3: 95 % of them are sampled."""
    temperature: float = 1.0
    """tau of the Gumbel-softmax: how smoothly a sample depends on its logit in the backward pass."""
    visible_only: bool = False
    """True: the loss lowers a row's sample only in views that draw the row (see ``StaticMaskSettings``); the paper's is
    of all rows."""
    draws: int = 10
    """n of the paper: rows that are sampled in none of n draws are removed."""
    seed: int = 0
    """Of all samples, together with the step."""

    def __post_init__(self) -> None:
        check_mask(self.sparsity_weight)
        if not self.temperature > 0 or self.draws < 1:
            raise ValueError(
                f"a sampled mask needs a temperature > 0 and draws >= 1, got {self.temperature} and {self.draws}"
            )

    def build(self, min_gaussians: int, scope: MaskScope | None = None) -> "SampledMask":
        """Return the mask; ``scope`` has no effect, because the mask is the same at all times."""
        return SampledMask(self, min_gaussians)


class SampledMask(LogitMask):
    """M ~ Bernoulli(sigma(m)), with the logits m as the column ``mask_logits``.

    A training step samples M, which gates the alphas of its rows (``splat``). A row with M = 0 changes no pixel, but
    the image tells its logit whether it would have helped. The paper has two logits for each row and samples by
    Gumbel-softmax; their difference is the m of this mask, and the difference of two Gumbel variables is logistic:
    M = 1[sigma((m + noise) / tau) > 1/2], differentiated as the sigmoid. Outside of training steps all rows show.

    Samples depend on seed and step alone, so a resumed run, and each of several processes, samples the same. Nodes
    share the stream.

    >>> mask = SampledMaskSettings(sparsity_weight=5e-4).build(min_gaussians=0)
    >>> rows = Rows({"mask_logits": torch.tensor([20.0, -20.0])})
    >>> mask.gates(rows, step=7).tolist(), mask.multipliers(rows, time=0.0).tolist(), mask.keep(rows).keep.tolist()
    ([1.0, 0.0], [1.0, 1.0], [True, False])
    """

    settings: SampledMaskSettings
    _step = 0

    def multipliers(self, rows: Rows, time: float) -> Float[Tensor, " n"]:
        """Return 1: a scene that is not in a training step shows all rows, with their own opacity and scale."""
        return torch.ones_like(rows.mask_logits.detach())

    def gates(self, rows: Rows, step: int) -> Float[Tensor, " n"]:
        """Return the samples of a step; if they are fewer than K_min, the nearest to being sampled join them."""
        self._step = step
        samples, fires = self._samples(rows)
        self.floor_firings = self.floor_firings + fires
        return samples

    def sparsity(self, rows: Rows, time: float, visible: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
        """Return n (mean of the step's samples)^2: divided by the rows of all nodes it is the paper's (mean M)^2,
        each node by its share of them."""
        samples, _ = self._samples(rows)
        if self.settings.visible_only:
            samples = samples * visible
        return samples.sum().square() / max(len(samples), 1)

    @torch.no_grad()
    def keep(self, rows: Rows) -> Selection:
        """Selects the rows that are sampled in any of n draws; the likeliest of the others fill up to K_min."""
        probabilities = self.scores(rows)
        # None of n draws has probability (1 - p)^n, so one uniform number stands for all of them.
        never = self._uniform(rows, "draws") < (1 - probabilities) ** self.settings.draws
        return keep_best(probabilities, never, self.min_gaussians)

    def _samples(self, rows: Rows) -> tuple[Float[Tensor, " n"], int | Bool[Tensor, ""]]:
        """The samples of the step, and whether K_min added to them."""
        with torch.autocast(rows.mask_logits.device.type, enabled=False):
            uniform = self._uniform(rows, "gates")
            noise = torch.log(uniform) - torch.log1p(-uniform)
            scores = torch.sigmoid((rows.mask_logits.float() + noise) / self.settings.temperature)
        floor = min(self.min_gaussians, len(scores))
        if floor == 0:
            return straight_through(scores, _LIKELIER), 0
        threshold, fires = lowered_threshold(scores.detach(), _LIKELIER, floor)
        return straight_through(scores, threshold), fires

    def _uniform(self, rows: Rows, purpose: str) -> Float[Tensor, " n"]:
        """Numbers in (0, 1) of each row, always the same at the same step."""
        logits = rows.mask_logits
        seed = named_seed(self.settings.seed, f"{purpose} {self._step}")
        generator = torch.Generator(logits.device).manual_seed(seed)
        uniform = torch.rand(len(logits), generator=generator, device=logits.device)
        return uniform.clamp(min=torch.finfo(uniform.dtype).tiny)
