"""How much of its room a view's lists fill: known on the device at once, on the host only after a wait."""

from dataclasses import dataclass
from typing import NamedTuple

import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from sparsestreet.ops.triton.language import constant, jit

# Places in the numbers on the device: all pairs, visible rows and bad rows, as the host reads them. Then the pairs and
# rows that are listed, which are none if they do not fit their room.
COUNTED = 3
LISTED_PAIRS, LISTED_ROWS = constant(3), constant(4)
LENGTH = 5


class Room(NamedTuple):
    """Most visible rows and pairs that lists can hold."""

    rows: int
    pairs: int

    def holds(self, pairs: int, rows: int) -> bool:
        return pairs <= self.pairs and rows <= self.rows


@dataclass
class Sizes:
    """Numbers of one view; on the host -1 until it has waited for them."""

    on_device: Int[Tensor, "5"]
    pairs: int = -1
    rows: int = -1
    """Visible ones."""


@jit
def store_sizes(sizes, pairs, rows, bad, fits):
    """Writes the numbers; all 64 bits wide, because pairs are counted before they are known to be few enough."""
    tl.store(sizes, pairs)
    tl.store(sizes + 1, rows)
    tl.store(sizes + 2, bad)
    tl.store(sizes + LISTED_PAIRS, tl.where(fits, pairs, 0))
    tl.store(sizes + LISTED_ROWS, tl.where(fits, rows, 0))
