"""Pairs of images for the tests of this folder."""

import torch

SIZES = [(7, 7), (7, 8), (9, 31), (33, 14), (40, 41)]
# scikit-image sums the same float64 values in another order; a few ulp of a map of order 1, times the number of terms.
TOLERANCE = 1e-11


def image_pair(size: tuple[int, int], seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, ...]:
    """A smooth image with a flat patch (where variances vanish) and a noisy copy of it."""
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(*size, 3, generator=generator, dtype=torch.float64)
    truth[: size[0] // 2, : size[1] // 2] = 0.7
    noise = 0.1 * torch.randn(*size, 3, generator=generator, dtype=torch.float64)
    return (truth + noise).clamp(0, 1).to(dtype), truth.to(dtype)
