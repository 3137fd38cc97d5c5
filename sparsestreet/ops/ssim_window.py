"""The window and the constants of SSIM (Wang et al. 2004), shared by all implementations of the loss."""

import math

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2  # (k1 L)^2 and (k2 L)^2 of the paper at data range L = 1


def window() -> tuple[float, ...]:
    """Weights of the 11 taps along one axis; they sum to 1."""
    taps = [math.exp(-((k - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for k in range(WINDOW)]
    return tuple(tap / sum(taps) for tap in taps)
