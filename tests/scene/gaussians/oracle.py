"""Selections with floors, one row at a time."""

from collections.abc import Sequence


def by_hand(
    scores: list[float], unwanted: list[bool], floor: int, ids: Sequence[int] = (), least: Sequence[int] = ()
) -> list[bool]:
    """Remove one row at a time: of the unwanted the lowest, the later of equals, whose removal no floor forbids."""
    ids = ids or [0] * len(scores)
    least = least or [0]
    keep = [True] * len(scores)
    for row in sorted(range(len(scores)), key=lambda row: (scores[row], -row)):
        left = sum(kept for kept, instance in zip(keep, ids, strict=True) if instance == ids[row])
        if unwanted[row] and sum(keep) > floor and left > least[ids[row]]:
            keep[row] = False
    return keep
