"""Mean and spread over runs or scenes."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Spread:
    """A mean with the sample standard deviation (n - 1); the latter is None below two values."""

    mean: float
    sd: float | None
    n: int


def spread(values: Sequence[float]) -> Spread | None:
    """Returns mean and sample standard deviation; None without values.

    >>> spread([24.0, 26.0, 28.0])
    Spread(mean=26.0, sd=2.0, n=3)
    """
    if not values:
        return None
    return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None, len(values))
