"""Where an image shows the recording car itself, in data sets whose cameras always show it in the same rows."""

import torch
from jaxtyping import Bool
from torch import Tensor


def bottom_rows(size: tuple[int, int], rows: int, recorded_height: int) -> Bool[Tensor, "h w"]:
    """True in the lowest ``rows`` of images that were recorded ``recorded_height`` rows high, at (width, height).

    A row of a scaled image that holds some of them is among them.
    """
    width, height = size
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[(recorded_height - rows) * height // recorded_height :] = True
    return mask
