"""The part of a log that is read: which of its frames, and which of its cameras."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

Name = TypeVar("Name", str, int)


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
