"""What only a device can decide: where long tiles are split, and which variant of a pixel kernel runs.

Every choice draws the same image and the same gradients, up to rounding where a field says so. On an H100 the defaults
were the fastest that was tried, or within 0.06 ms of it (docs/gpu.md). No other device has been asked.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """One choice of each. Times are of the pixel kernels of one view of a trained street, 1.2 M splats at 960x576."""

    most_parts: int = 6144
    """Most parts of a view, 7 kB each. A part has at least one of so many shares of all pairs; 1: no tile is split.

    A street lasts as long as its longest tile. Measured: forward 3.4 ms without a split, 0.73 with; backward 5.2 and
    0.78. Moves images by rounding, as the light before a part is a product of other parts' products."""
    shortest_part: int = 128
    """Least number of pairs of a part. It bounds what parts cost in small views."""
    fewest_parts: int = 3
    """Parts of the shortest tile that is split. What a split costs is too much for two parts."""
    two_launches: bool = True
    """Forward in two launches and the sum: whole tiles, the first parts and what later ones let through; then those.
    Backward in one. Otherwise whole tiles, products and parts wait for each other.

    Measured: forward 0.92 to 0.73 ms, backward 1.17 to 0.78. The first kernel keeps the registers of the blend also
    while it computes products. The same bits in the interpreter."""
    marked_slots: bool = False
    """Backward marks the slots that it writes, a byte each, and writes no zeros into those behind closed pixels.

    Not measured. Modelled: nothing for a street, which closes few tiles early; perhaps 1.6 of 2.6 ms for 5 M random
    splats at 960x640. Costs 2 to 14 instructions a pair and a fill of the bytes. The same bits."""
    staged: bool = True
    """Forward fetches the records of 32 pairs at once, one a lane.

    A warp then waits for memory once in 32 pairs. Measured: 0.73 to 0.58 ms, and 9 to 33 % less with 100,000 random
    splats and more. The same bits in the interpreter."""

    def __post_init__(self) -> None:
        if self.most_parts < 1 or self.shortest_part < 1 or self.fewest_parts < 2:
            raise ValueError(f"a view has at least 1 part of 1 pair, a split tile at least 2 parts, got {self}")


_tunings = [Tuning()]


def tuning() -> Tuning:
    """The choices that hold now."""
    return _tunings[-1]


@contextmanager
def tuned(choices: Tuning) -> Iterator[None]:
    """Other choices, for benchmarks and tests. All threads get them, because autograd has threads of its own."""
    _tunings.append(choices)
    try:
        yield
    finally:
        _tunings.pop()
