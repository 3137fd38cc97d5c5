"""Student's t intervals of paired differences."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.special import stdtrit

CONFIDENCE = 0.95


@dataclass(frozen=True)
class ConfidenceInterval:
    """A mean with an interval that holds the true mean with ``CONFIDENCE`` if the differences are normal."""

    mean: float
    low: float | None
    """None for a single value, which says nothing about its spread."""
    high: float | None
    n: int

    @property
    def proven(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


def t_interval(values: Sequence[float]) -> ConfidenceInterval | None:
    """Returns the mean and the t interval with n - 1 degrees of freedom; None without values.

    >>> interval = t_interval([0.2, 0.3, 0.4])
    >>> f"{interval.mean:.2f} [{interval.low:.2f}, {interval.high:.2f}]", interval.proven
    ('0.30 [0.05, 0.55]', True)
    """
    if not values:
        return None
    mean, n = statistics.fmean(values), len(values)
    if n == 1:
        return ConfidenceInterval(mean, None, None, 1)
    reach = float(stdtrit(n - 1, (1 + CONFIDENCE) / 2)) * statistics.stdev(values) / math.sqrt(n)
    return ConfidenceInterval(mean, mean - reach, mean + reach, n)
