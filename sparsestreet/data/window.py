"""The part of a log that is read: which of its frames, and which of its cameras."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

Name = TypeVar("Name", str, int)

_SHOWN = 8
"""Names that an error lists."""


def listed(names: Sequence[str]) -> str:
    """What a choice can be, for the error of one that is not there: the first few names, and how many there are.

    >>> listed(["a", "b"]), listed([])
    ('a, b', 'none')
    >>> listed(list("abcdefghij"))
    'a, b, c, d, e, f, g, h, ... (10 in all)'
    """
    more = f", ... ({len(names)} in all)" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more or "none"


def frame_window(num_frames: int, first_frame: int, last_frame: int, root: Path) -> range:
    """Frames first_frame .. last_frame, included; -1: to the end. Raises ValueError for frames that ``root`` lacks."""
    last = num_frames - 1 if last_frame == -1 else last_frame
    if not 0 <= first_frame <= last < num_frames:
        raise ValueError(f"frames {first_frame} to {last_frame} are not within the log's 0 to {num_frames - 1}: {root}")
    return range(first_frame, last + 1)


def chosen_cameras(found: Sequence[Name], wanted: Sequence[Name] | None, root: Path) -> tuple[Name, ...]:
    """The wanted ones of a log's cameras, in their order; None: all. Raises ValueError for any that ``root`` lacks."""
    chosen = tuple(found) if wanted is None else tuple(wanted)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(found):
        raise ValueError(f"cameras {list(chosen)} must be different ones of the log's {list(found)}: {root}")
    return chosen
