"""Stored values of an image and the light that they stand for: sRGB (IEC 61966-2-1), continued to all numbers."""

import torch
from jaxtyping import Float
from torch import Tensor


def light_of(stored: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Linear light; 1 is white, and values outside of [0, 1] follow the same formula.

    >>> light_of(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    # The power of what takes the other branch would have no gradient.
    return torch.where(stored <= 0.04045, stored / 12.92, ((stored.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def stored_of(light: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """The inverse of ``light_of``."""
    power = 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, power)
