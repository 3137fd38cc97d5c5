"""Names that others wrote: as a terminal may show them, and those that were probably meant."""

import difflib
from collections.abc import Iterable

LONGEST = 100
"""Letters of a name that are compared: difflib takes seconds for a name of megabytes."""


def printable(text: str) -> str:
    r"""Returns a text whose control characters are written out; lines and tabs stay.

    A terminal obeys them: it is cleared, renamed, or shows another text than stands there.

    >>> printable("car\x1b[2J"), printable("one\ntwo"), one_line("one\ntwo")
    ('car\\x1b[2J', 'one\ntwo', 'one\\ntwo')
    """
    return "".join(one if one.isprintable() or one in "\n\t" else repr(one)[1:-1] for one in text)


def one_line(name: str) -> str:
    """Returns a name on one line, its control characters written out, cut where it is long."""
    shown = "".join(one if one.isprintable() else repr(one)[1:-1] for one in name[: LONGEST + 1])
    return shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}..."


def nearest(name: str, known: Iterable[str], most: int = 1, cutoff: float = 0.6) -> list[str]:
    """Returns the known names that are most like one, the nearest first; long ones are compared by their beginnings.

    Args:
        name: what was written.
        known: names there are.
        most: how many are returned at most.
        cutoff: in 0 to 1: how like they must be at least (difflib's ratio).
    """
    short = {one[:LONGEST]: one for one in known}
    return [short[one] for one in difflib.get_close_matches(name[:LONGEST], short, n=most, cutoff=cutoff)]
