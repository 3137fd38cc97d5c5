"""One number for many: what must stay as it is, and has no oracle but what it was."""

import numpy as np
from numpy.typing import ArrayLike


def weighed(values: ArrayLike) -> float:
    """A sum in which each value counts, and its place too.

    The weights lie in [0, 1): fractions of the golden ratio times squares, which no smooth function follows.
    """
    flat = np.asarray(values, np.float64).ravel()
    return float(flat @ (np.arange(len(flat)) ** 2 * 0.6180339887498949 % 1))
