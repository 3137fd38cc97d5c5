"""Coverage of a pixel by stripes: analytic filters of textures, so that far ones turn gray instead of noisy."""

import numpy as np
from jaxtyping import Float32

Scalars = Float32[np.ndarray, " n"]


def strip(x: Scalars, low: float, high: float, footprint: Scalars) -> Scalars:
    """Returns the share of the interval of length ``footprint`` around x that lies in [low, high].

    >>> strip(np.float32([0.0]), 0.0, 1.0, np.float32([1.0])).tolist()
    [0.5]
    """
    half = footprint * np.float32(0.5)
    overlap = np.minimum(x + half, np.float32(high)) - np.maximum(x - half, np.float32(low))
    return np.clip(overlap / np.maximum(footprint, np.float32(1e-6)), 0, 1)


def beyond(x: Scalars, edge: float, footprint: Scalars) -> Scalars:
    """Returns the share of the interval of length ``footprint`` around x that lies above ``edge``.

    >>> beyond(np.float32([0.25]), 0.0, np.float32([1.0])).tolist()
    [0.75]
    """
    return np.clip((x - np.float32(edge)) / np.maximum(footprint, np.float32(1e-6)) + np.float32(0.5), 0, 1)


def stripes(x: Scalars, period: float, low: float, high: float, footprint: Scalars) -> Scalars:
    """Returns the share of the interval of length ``footprint`` around x in the strips [low, high] + k period.

    0 <= low < high <= period.

    >>> stripes(np.float32([5.0]), 2.0, 0.0, 1.0, np.float32([4.0])).tolist()
    [0.5]
    """
    width = np.maximum(footprint, np.float32(1e-6))
    half = width * np.float32(0.5)
    return (_painted(x + half, period, low, high) - _painted(x - half, period, low, high)) / width


def _painted(x: Scalars, period: float, low: float, high: float) -> Scalars:
    """Returns the length of the strips between 0 and x."""
    whole = np.floor(x * np.float32(1 / period))
    rest = x - whole * np.float32(period)
    return whole * np.float32(high - low) + np.clip(rest - np.float32(low), 0, np.float32(high - low))
