"""Density control of 3DGS-MCMC (Kheradmand et al. 2024): a fixed budget, dead Gaussians move to where others are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.scene.density.gradient import GradientDensity
from sparsestreet.scene.density.strategy import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan, Rows


@dataclass(frozen=True)
class McmcDensity(GradientDensity):
    """Relocates dead rows, grows by a share up to the cap, and shakes faint rows after every step.

    Nothing is split, culled or reset. Of the options of ``GradientDensity``, which files of nodes set, only
    ``cull_opacity`` has an effect: a row with no more than this opacity is dead. Lengths are counted in ``unit``,
    because the noise multiplies a length (the learning rate) with an area (the covariance).

    Raises ValueError for options out of range.
    """

    growth: float = 0.05
    """Share of its rows by which a node grows at a refinement, up to its ``max_gaussians``."""
    noise_rate: float = 5e5
    """lambda_noise of the paper."""
    sharpness: float = 100.0
    """k of the paper: how quickly the noise falls with the opacity, around that of a dead row."""
    opacity_weight: float = 0.01
    """lambda_o of the paper, for the mean opacity of the rows."""
    scale_weight: float = 0.01
    """lambda_Sigma of the paper, for the mean standard deviation of the rows and axes."""
    unit: float = 8.0
    """Meters. The paper's scenes have a radius of about 5 units, a street one of 40 m."""

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = (self.growth, self.noise_rate, self.sharpness, self.opacity_weight, self.scale_weight)
        if not (min(numbers) >= 0 and self.unit > 0):
            raise ValueError(
                "growth, noise_rate, sharpness and weights must be >= 0 and unit > 0, got "
                f"{', '.join(map(str, numbers))} and {self.unit}"
            )

    def densify(
        self,
        rows: Rows,
        statistics: DensityStatistics,
        *,
        radius: float,
        progress: float,
        max_gaussians: int | None,
        generator: torch.Generator,
    ) -> RowPlan:
        """Give every dead row, and every row by which the node grows, the place of a live one.

        The live ones are drawn in proportion to their opacity, with replacement. The N rows that then share a place
        get the opacity and scale of ``shared``, so that together they look like the one before. All of them start with
        zero moments; other columns are copies. The dead keep their place in the order, the new rows come last.
        """
        opacities = torch.sigmoid(rows.opacity_logits.detach())
        live = opacities > self.cull_opacity
        source = torch.arange(len(rows), device=live.device)
        wanted = int((1 + self.growth) * len(rows))
        grown = max((wanted if max_gaussians is None else min(wanted, max_gaussians)) - len(rows), 0)
        if not live.any():
            return RowPlan(len(rows), source, torch.zeros_like(live))
        places = torch.cat((torch.nonzero(~live).squeeze(-1), len(rows) + torch.arange(grown, device=live.device)))
        source = torch.cat((source, source.new_zeros(grown)))
        source[places] = _drawn(opacities * live, len(places), generator)
        counts = torch.bincount(source, minlength=len(rows))[source]
        logits, log_scales = shared(rows.opacity_logits.detach()[source], rows.log_scales.detach()[source], counts)
        return RowPlan(len(rows), source, fresh=counts > 1, edits={"opacity_logits": logits, "log_scales": log_scales})

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        """Return the plan that keeps all rows."""
        return RowPlan.keep(torch.ones(len(rows), dtype=torch.bool, device=rows.means.device))

    def reset(self, rows: Rows) -> RowPlan:
        """Return the plan that keeps all rows as they are."""
        return RowPlan.keep(torch.ones(len(rows), dtype=torch.bool, device=rows.means.device))

    def noise(self, rows: Rows, rate: float, seed: int) -> Float[Tensor, "n 3"]:
        """Return lambda_lr lambda_noise sigmoid(-k (o - t)) Sigma eta with eta ~ N(0, I), meters.

        lambda_lr is the ``rate`` of the means, t the opacity of a dead row.
        """
        opacities = torch.sigmoid(rows.opacity_logits.detach())
        faint = torch.sigmoid(-self.sharpness * (opacities - self.cull_opacity))
        generator = torch.Generator(faint.device).manual_seed(seed)
        eta = torch.randn(len(rows), 3, generator=generator, device=faint.device, dtype=faint.dtype)
        rotations = to_matrix(rows.quaternions.detach())
        variances = (2 * rows.log_scales.detach()).exp() / self.unit**2
        spread = rotations @ (variances[..., None] * (rotations.mT @ eta[..., None]))
        return rate * self.noise_rate * faint[:, None] * spread.squeeze(-1)

    def regularizers(self, rows: Rows) -> Mapping[str, Float[Tensor, ""]]:
        """Return lambda_o times the mean opacity and lambda_Sigma times the mean scale.

        The paper writes sums, which with its weights would outweigh every image.
        """
        if len(rows) == 0:
            return {}
        return {
            "mcmc_opacity": self.opacity_weight * torch.sigmoid(rows.opacity_logits).mean(),
            "mcmc_scale": self.scale_weight * rows.log_scales.exp().mean() / self.unit,
        }


def shared(
    logits: Float[Tensor, " n"], log_scales: Float[Tensor, "n 3"], counts: Int[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return opacity logits and logarithmic scales of N = ``counts`` equal rows that together look like one.

    o' = 1 - (1 - o)^(1 / N), and the scales are multiplied by o / D with::

        D = sum_{i=1..N} sum_{k=0..i-1} binomial(i - 1, k) (-1)^k o'^(k + 1) / sqrt(k + 1)

    The sum alternates and loses all digits for large N. But it is what N Gaussians of peak o' on one another leave of a
    line, sum_i o' g (1 - o' g)^(i - 1) = 1 - (1 - o' g)^N with g(x) = exp(-x^2 / 2), integrated over the line and
    divided by sqrt(2 pi). So D is computed as that integral, by the trapezoid rule.

    >>> logits, scales = shared(torch.tensor([0.0]), torch.zeros(1, 3), torch.tensor([2]))
    >>> round(float(torch.sigmoid(logits)), 4), round(float(scales[0, 0].exp()), 4)
    (0.2929, 0.9522)
    """
    several = torch.nonzero(counts > 1).squeeze(-1)
    logits, log_scales, number = logits.clone(), log_scales.clone(), counts[several].double()
    old = logits[several].double()
    transparent = torch.nn.functional.logsigmoid(-old) / number  # log(1 - o')
    new = -torch.expm1(transparent)
    x = torch.linspace(0, _REACH, _NODES, dtype=torch.float64, device=logits.device)
    covered = -torch.expm1(number[:, None] * torch.log1p(-new[:, None] * torch.exp(-x.square() / 2)))
    total = 2 * torch.trapezoid(covered, x, dim=1) / math.sqrt(2 * math.pi)
    logits[several] = (new.log() - transparent).to(logits)
    log_scales[several] += (torch.sigmoid(old) / total).log()[:, None].to(log_scales)
    return logits, log_scales


_REACH = 10.0
"""Standard deviations: beyond, less than 1e-22 is left."""
_NODES = 161
"""The trapezoid rule of a smooth even function that ends at 0 gains digits with every node."""


def _drawn(weights: Float[Tensor, " n"], number: int, generator: torch.Generator) -> Int[Tensor, " m"]:
    """Return ``number`` rows, drawn with replacement in proportion to their weights (torch's own takes 2^24 at most).

    Drawn on the generator's device, so that a CPU generator gives the same rows on every device.
    """
    total = weights.double().cumsum(0)
    uniform = torch.rand(number, dtype=torch.float64, generator=generator, device=generator.device).to(total.device)
    # A draw that rounds up to the total would lie behind the last row.
    return torch.searchsorted(total, uniform * total[-1], right=True).clamp(max=int(weights.nonzero()[-1]))
