"""Names: as a terminal may show them, those that were probably meant, and those of checkpoints that stay."""

import difflib
import re
from collections.abc import Iterable
from pathlib import Path

FOUND = "found_"
"""Begins the names of objects that nobody annotated: lidar showed that they move."""
LONGEST = 100
"""Letters of a name that are compared: difflib takes seconds for a name of megabytes."""


def printable(text: str) -> str:
    r"""Return a text whose control characters are written out; lines and tabs stay.

    A terminal obeys them: it is cleared, renamed, or shows another text than stands there.

    >>> printable("car\x1b[2J"), printable("one\ntwo"), one_line("one\ntwo")
    ('car\\x1b[2J', 'one\ntwo', 'one\\ntwo')
    """
    return "".join(one if one.isprintable() or one in "\n\t" else repr(one)[1:-1] for one in text)


def one_line(name: str) -> str:
    """Return a name on one line, its control characters written out, cut where it is long."""
    shown = "".join(one if one.isprintable() else repr(one)[1:-1] for one in name[: LONGEST + 1])
    return shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}..."


def nearest(name: str, known: Iterable[str], most: int = 1, cutoff: float = 0.6) -> list[str]:
    """Return the known names that are most like one, the nearest first; long ones are compared by their beginnings.

    Args:
        name: what was written.
        known: names there are.
        most: how many are returned at most.
        cutoff: in 0 to 1: how like they must be at least (difflib's ratio).
    """
    short = {one[:LONGEST]: one for one in known}
    return [short[one] for one in difflib.get_close_matches(name[:LONGEST], short, n=most, cutoff=cutoff)]


def kept_before(moment: float) -> str:
    """Return the name of the checkpoint that has the last step before what happens after a fraction of the run.

    >>> kept_before(0.93334)
    'before_0.93334.ckpt'
    """
    return f"before_{moment!r}.ckpt"


def checkpoint_fraction(checkpoint: Path) -> float | None:
    """Return the fraction of the run before which a checkpoint was kept; None for another checkpoint.

    >>> checkpoint_fraction(Path("checkpoints/before_0.6.ckpt")), checkpoint_fraction(Path("checkpoints/last.ckpt"))
    (0.6, None)
    """
    found = re.fullmatch(r"before_([\d.e-]+)\.ckpt", checkpoint.name)
    return float(found[1]) if found else None
