"""Selections with a floor, one row at a time."""


def by_hand(scores: list[float], unwanted: list[bool], floor: int) -> list[bool]:
    """Remove one row at a time: the lowest, the later of equals, while it is unwanted and the floor allows."""
    keep = [True] * len(scores)
    while sum(keep) > floor:
        row = min((row for row in range(len(scores)) if keep[row]), key=lambda row: (scores[row], -row))
        if not unwanted[row]:
            break
        keep[row] = False
    return keep
