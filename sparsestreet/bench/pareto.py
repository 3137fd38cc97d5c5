"""Which points no other point beats in both time and error."""

from collections.abc import Sequence


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (cost, error) that are not dominated, by rising cost.

    A point is dominated if another is no worse in both and better in one; of equal points the first is kept.
    """
    front, least = [], float("inf")
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if points[index][1] < least:
            front.append(index)
            least = points[index][1]
    return front
