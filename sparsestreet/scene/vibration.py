"""Motion and fading of a Gaussian of PVG (Chen et al. 2023). It swings about its mean and shows around its life peak.

Times are in the node's unit (0.02 a frame in PVG). Ages are times since the life peak, life spans standard deviations.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.ops.raw import OPACITY_LOGIT_LIMIT


def displacements(velocities: Float[Tensor, "n 3"], ages: Float[Tensor, " n"], cycle: float) -> Float[Tensor, "n 3"]:
    """Returns v sin(age a) / a with a = 2 pi / cycle, meters. The Gaussian moves with v at its life peak, never far.

    >>> displacements(torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([0.0]), cycle=0.2).tolist()
    [[0.0, 0.0, 0.0]]
    """
    rate = 2 * math.pi / cycle
    return velocities * (torch.sin(ages * rate) / rate)[:, None]


def mean_velocities(
    velocities: Float[Tensor, "n 3"], log_life_spans: Float[Tensor, " n"], cycle: float
) -> Float[Tensor, "n 3"]:
    """Returns v exp(-rho / 2) with the staticness rho = life span / cycle; a Gaussian of many swings goes nowhere.

    >>> mean_velocities(torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([-100.0]), cycle=0.2).tolist()
    [[2.0, 0.0, 0.0]]
    """
    return velocities * torch.exp(-0.5 / cycle * log_life_spans.exp())[:, None]


def faded_logits(opacity_logits: Float[Tensor, " n"], log_factors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Returns the logit of sigmoid(logit) exp(log_factor), for log factors <= 0; exact if the product is close to 1.

    >>> torch.sigmoid(faded_logits(torch.zeros(1), torch.tensor([0.5]).log())).tolist()
    [0.25]
    """
    limited = opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT)
    log_opacity = torch.nn.functional.logsigmoid(limited) + log_factors
    return log_opacity - torch.log(-torch.expm1(log_opacity))
