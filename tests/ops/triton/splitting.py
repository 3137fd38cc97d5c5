"""Another rule by which long tiles are split into parts, for small scenes."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from sparsestreet.ops.triton import parts


@dataclass(frozen=True)
class Rule:
    """The constants of parts.py."""

    min_part_pairs: int = parts.MIN_PART_PAIRS
    max_parts: int = parts.MAX_PARTS
    min_parts: int = parts.MIN_PARTS


@contextmanager
def split_by(rule: Rule) -> Iterator[None]:
    """The rule holds inside, in all threads, because autograd has threads of its own."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in vars(rule).items():
            patch.setattr(parts, name.upper(), value)
        yield


def part_length(pairs: int) -> int:
    """Least number of pairs of a part, for a view with ``pairs``."""
    return max(parts.MIN_PART_PAIRS, -(-pairs // parts.MAX_PARTS))


def split_length(pairs: int) -> int:
    """Least number of pairs of a tile that is split, for a view with ``pairs``."""
    return parts.MIN_PARTS * part_length(pairs)
