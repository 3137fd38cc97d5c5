"""How a Gaussian of PVG (Chen et al. 2023) moves and fades: it swings about its mean and is seen around its life peak.

Times are those of the node (0.02 a frame in PVG): ages are times since the life peak, life spans standard deviations.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops.raw import OPACITY_LOGIT_LIMIT


def displacements(velocities: Float[Tensor, "n 3"], ages: Float[Tensor, " n"], cycle: float) -> Float[Tensor, "n 3"]:
    """v sin(age a) / a with a = 2 pi / cycle: at the life peak it moves by its velocity, and never far away."""
    rate = 2 * math.pi / cycle
    return velocities * (torch.sin(ages * rate) / rate)[:, None]


def mean_velocities(
    velocities: Float[Tensor, "n 3"], log_life_spans: Float[Tensor, " n"], cycle: float
) -> Float[Tensor, "n 3"]:
    """v exp(-rho / 2) with the staticness rho = life span / cycle: who lives for many swings goes nowhere."""
    return velocities * torch.exp(-0.5 / cycle * log_life_spans.exp())[:, None]


def faded_logits(opacity_logits: Float[Tensor, " n"], log_factors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The logit of sigmoid(logit) exp(log_factor), for log factors <= 0; exact where the product is close to 1."""
    limited = opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT)
    log_opacity = torch.nn.functional.logsigmoid(limited) + log_factors
    return log_opacity - torch.log(-torch.expm1(log_opacity))
