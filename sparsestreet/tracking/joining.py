"""Chains that one object explains: one behind the other in time, or side by side at one velocity."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64

from sparsestreet.tracking.association import YOUNG, Chain
from sparsestreet.tracking.fit import Fit
from sparsestreet.tracking.path import turned
from sparsestreet.tracking.settings import TrackingSettings

END = 8
"""Steps at the end of a chain over which its velocity is taken."""
BESIDE_COST = 10.0
"""Chains behind each other are joined before pieces of one object are."""
SHARED = 0.5
"""Share of the shorter chain's steps at which both must be seen to be pieces of one object."""
LONG = 2.6
"""Meters, length of what may come in pieces that are apart: a vehicle."""


@dataclass(frozen=True)
class _Piece:
    """A chain, what it is fitted by, and a number that tells which was made first."""

    chain: Chain
    fit: Fit
    number: int


def join_chains(
    chains: Sequence[Chain],
    fitted: Callable[[Chain], Fit],
    seconds: Float64[np.ndarray, " t"],
    settings: TrackingSettings,
) -> list[Chain]:
    """Return fewer chains: the two that fit best become one, until none fit.

    Args:
        chains: pieces.
        fitted: shape and path of a chain.
        seconds: time of every step of the drive.
        settings: how long an object may be hidden.
    """
    pieces = [_Piece(chain, fitted(chain), number) for number, chain in enumerate(chains)]
    cost = partial(_cost, seconds=seconds, settings=settings)
    pairs = [(a, b) for a in pieces for b in pieces if a is not b]
    costs = {(a.number, b.number): value for a, b in pairs if (value := cost(a.fit, b.fit)) < np.inf}
    while costs:
        best = min((value, pair) for pair, value in costs.items())
        both = [piece for piece in pieces if piece.number in best[1]]
        chain = Chain.merged([piece.chain for piece in both])
        new = _Piece(chain, fitted(chain), max(piece.number for piece in pieces) + 1)
        pieces = [piece for piece in pieces if piece.number not in best[1]]
        costs = {pair: value for pair, value in costs.items() if not set(pair) & set(best[1])}
        pairs = [pair for other in pieces for pair in ((other, new), (new, other))]
        costs |= {(a.number, b.number): value for a, b in pairs if (value := cost(a.fit, b.fit)) < np.inf}
        pieces.append(new)
    return [piece.chain for piece in pieces]


def _cost(a: Fit, b: Fit, *, seconds: Float64[np.ndarray, " t"], settings: TrackingSettings) -> float:
    """Meters by which b fails to be the same object as a, later or beside it; infinite where it cannot be."""
    gap = float(seconds[b.steps[0]] - seconds[a.steps[-1]])
    if gap > 0:
        return _behind(a, b, gap, seconds) if gap < settings.max_lost else np.inf
    both = np.arange(max(a.steps[0], b.steps[0]), min(a.steps[-1], b.steps[-1]) + 1)
    seen = both[(a.counts[both - a.steps[0]] > 0) & (b.counts[both - b.steps[0]] > 0)]
    shorter = min(len(a.steps), len(b.steps))
    return _beside(a, b, seen) if len(seen) >= max(YOUNG, SHARED * shorter) else np.inf


def _behind(a: Fit, b: Fit, gap: float, seconds: Float64[np.ndarray, " t"]) -> float:
    """Distance between where the mean velocity leads from the end of a, and where b begins."""
    left, entered = _velocity(a, seconds, last=True), _velocity(b, seconds, last=False)
    miss = np.linalg.norm(a.path[-1] + (left + entered) / 2 * gap - b.path[0])
    alike = np.linalg.norm(left - entered) < 1.5 + 0.2 * np.linalg.norm(left)
    return float(miss) if alike and miss < 1 + gap else np.inf


def _velocity(fit: Fit, seconds: Float64[np.ndarray, " t"], *, last: bool) -> Float64[np.ndarray, "2"]:
    count = min(END, len(fit.path))
    rows = slice(-count, None) if last else slice(None, count)
    times, path = seconds[fit.steps[rows]], fit.path[rows]
    return (path[-1] - path[0]) / (times[-1] - times[0])


def _beside(a: Fit, b: Fit, both: Int64[np.ndarray, " k"]) -> float:
    """Distance along the heading of two pieces that keep their places to each other while they move."""
    path, other = a.path[both - a.steps[0]], b.path[both - b.steps[0]]
    yaw = a.yaw[both - a.steps[0]]
    moved = float(np.linalg.norm(path[-1] - path[0]))
    along, across = np.median(np.abs(turned(other - path, -yaw)), axis=0)
    lengths = a.shape.size[0], b.shape.size[0]
    is_long = max(lengths) > LONG
    space = along - sum(lengths) / 2
    rigid = (other - path).std(0).max() < 0.5 + 0.03 * moved
    near = space < (1.0 if is_long else 0.0) and across < (1.8 if is_long else 0.5)
    return BESIDE_COST + float(along) if moved > 1 and rigid and near else np.inf
