"""How long the pixel kernels of a view take on a large GPU, modelled: warps of different length on schedulers.

132 multiprocessors have four schedulers each. A scheduler holds as many one-warp programs as their registers allow, and
takes the next as soon as one ends. Of n that it holds, each takes ``wait + n * issue`` microseconds for a pair: what a
lone warp waits for memory, and what the others' instructions take. Both were fitted to the H100's records of views
without split tiles (benchmarks/gpu.jsonl, gpu_960x640.jsonl). They cannot be told apart well, so three fits stand
beside each other. Later the device confirmed what they say of a street (docs/gpu.md).

Not modelled: caches, empty programs, the sums of part layers (some 20 us), and what closes early.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SCHEDULERS = 132 * 4
WARPS = 132 * 20
"""Warps of the pixel kernels that run at once: with an exclusive stop, and backward."""
FORWARD, BACKWARD = ((0.2, 0.07), (0.45, 0.01), (0.4, 0.03)), ((0.4, 0.12), (0.6, 0.08))
"""Fits: microseconds of ``wait`` and ``issue``."""
THIN = 0.55
"""What a part's transmittance takes of a blend: 66 of 119 instructions a pair, of which 1.7 quadrants are touched."""


@dataclass(frozen=True)
class Split:
    """Numbers of pairs: of whole tiles in the order in which they start, and of each part of each split tile."""

    whole: list[int]
    parts: list[list[int]]
    ahead: int
    """Number of whole tiles that start before the parts where both start together."""

    @property
    def chains(self) -> list[float]:
        """Pairs that one tile's warps walk after each other: all of a whole tile, and of a split one the transmittance
        of a part and then a part, both counted in full."""
        return [*self.whole, *(2.0 * max(parts) for parts in self.parts)]


def makespan(programs: Sequence[float], fit: tuple[float, float], resident: int = 5) -> float:
    """Milliseconds until the last of a kernel's programs ends; they start in this order."""
    wait, issue = fit
    queue = iter(programs)
    held: list[list[float]] = [[] for _ in range(SCHEDULERS)]
    for _ in range(resident):
        # A program is taken only for a scheduler that there is.
        for heap, pairs in zip(held, queue, strict=False):
            heapq.heappush(heap, pairs)
    # Pairs that each program of a scheduler has walked since the kernel began, and the next to end of all.
    walked = [0.0] * SCHEDULERS
    ends = [(heap[0] * (wait + len(heap) * issue), i) for i, heap in enumerate(held) if heap]
    heapq.heapify(ends)
    now = 0.0
    while ends:
        now, i = heapq.heappop(ends)
        walked[i] = heapq.heappop(held[i])
        following = next(queue, None)
        if following is not None:
            heapq.heappush(held[i], walked[i] + following)
        if held[i]:
            heapq.heappush(ends, (now + (held[i][0] - walked[i]) * (wait + len(held[i]) * issue), i))
    return 1e-3 * now


def four_launches(split: Split, fit: tuple[float, float]) -> float:
    """Forward: whole tiles, then the transmittance of all parts but a tile's last, then all parts."""
    thin = [THIN * pairs for parts in split.parts for pairs in parts[:-1]]
    blended = [pairs for parts in split.parts for pairs in parts]
    return makespan(split.whole, fit) + makespan(thin, fit, resident=8) + makespan(blended, fit)


def together(split: Split, parts: Sequence[float]) -> list[float]:
    """Whole tiles and parts in the order in which they start."""
    return [*split.whole[: split.ahead], *parts, *split.whole[split.ahead :]]


def two_launches(split: Split, fit: tuple[float, float]) -> float:
    """Forward: whole tiles, first parts, and the transmittance of middle ones; then all parts but the first."""
    first = [parts[0] if i == 0 else THIN * parts[i] for parts in split.parts for i in range(len(parts) - 1)]
    return makespan(together(split, first), fit) + makespan([n for parts in split.parts for n in parts[1:]], fit)


def lengths_of(quantiles: dict[float, int], tiles: int) -> NDArray[np.int64]:
    """Tiles' numbers of pairs with these quantiles, straight lines between them, in a random order."""
    at = (np.arange(tiles) + 0.5) / tiles
    lengths = np.interp(at, list(quantiles), list(quantiles.values())).round().astype(np.int64)
    return np.random.default_rng(0).permutation(lengths)
