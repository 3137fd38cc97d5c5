"""A straight line through measurements."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """y = intercept + slope x."""

    slope: float
    intercept: float
    r_squared: float
    """Share of the (weighted) variance that the line explains; 1 where the points do not vary."""

    def at(self, x: float) -> float:
        return self.intercept + self.slope * x


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line:
    """Least squares of relative residuals (weights 1/y^2), so that small times count as much as large ones.

    Raises ValueError for fewer than two different x, or a y that is not positive.
    """
    if not all(b > 0 for b in y):
        raise ValueError(f"relative residuals need values > 0, got {min(y)}: measure longer")
    weights = [1 / b**2 for b in y]

    def mean(values: Sequence[float]) -> float:
        return sum(w * value for w, value in zip(weights, values, strict=True)) / sum(weights)

    if len(set(x)) < 2:
        raise ValueError(f"a line needs at least two different x, got {sorted(set(x))}: measure more sizes")
    mean_x, mean_y = mean(x), mean(y)
    covariance = mean([(a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)])
    slope = covariance / mean([(a - mean_x) ** 2 for a in x])
    line = Line(slope, mean_y - slope * mean_x, 1.0)
    total = mean([(b - mean_y) ** 2 for b in y])
    residual = mean([(b - line.at(a)) ** 2 for a, b in zip(x, y, strict=True)])
    return line if total == 0 else Line(line.slope, line.intercept, 1 - residual / total)
