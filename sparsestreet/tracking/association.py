"""Clusters of successive instants that are one object: each is predicted at constant velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import linear_sum_assignment

from sparsestreet.tracking.clusters import Cluster
from sparsestreet.tracking.scans import Returns
from sparsestreet.tracking.settings import TrackingSettings

NEVER = 1e6
"""Cost of what cannot be."""
UNLIKE = 0.7
"""Meters that a difference of sizes by a factor e costs."""
MAX_UNLIKE = 1.2
"""Logarithm of the greatest factor between the sizes of one object at two instants."""
YOUNG = 3
"""Instants after which a velocity is trusted."""


@dataclass(frozen=True)
class Chain:
    """The returns of one object, or of a piece of one, at some of the steps of a drive."""

    steps: Int64[np.ndarray, " n"]
    """Numbers of instants, increasing."""
    parts: tuple[Returns, ...]
    """One for each step; none is empty."""

    def __len__(self) -> int:
        return len(self.steps)

    @staticmethod
    def merged(chains: Sequence["Chain"]) -> "Chain":
        """Return the chain of all returns of several."""
        parts: dict[int, list[Returns]] = {}
        for chain in chains:
            for step, part in zip(chain.steps.tolist(), chain.parts, strict=True):
                parts.setdefault(step, []).append(part)
        steps = sorted(parts)
        return Chain(np.array(steps, np.int64), tuple(Returns.joined(parts[step]) for step in steps))


class _Open:
    """A chain that may go on."""

    def __init__(self, step: int, cluster: Cluster) -> None:
        self.steps, self.parts = [step], [cluster.returns]
        self.place, self.extent = cluster.middle, cluster.extent
        self.velocity = np.zeros(2)

    def take(self, step: int, cluster: Cluster, passed: float) -> None:
        """Add a cluster, ``passed`` seconds after the last one: an alpha-beta filter whose gains fall with age."""
        age = len(self.steps)
        measured = (cluster.middle - self.place) / passed
        predicted = self.place + self.velocity * passed
        self.velocity = self.velocity + (1.0 if age == 1 else max(0.3, 1 / age)) * (measured - self.velocity)
        self.place = cluster.middle if age < YOUNG else predicted + 0.6 * (cluster.middle - predicted)
        self.extent += 0.3 * (cluster.extent - self.extent)
        self.steps.append(step)
        self.parts.append(cluster.returns)

    def gate(self, passed: float, settings: TrackingSettings) -> float:
        """Return how far from its prediction the object may be, meters."""
        if len(self.steps) == 1:
            return 0.6 + 0.8 * settings.max_speed * passed
        return 0.9 + (6.0 if len(self.steps) < YOUNG else 3.0) * passed

    def lost(self, passed: float, period: float) -> bool:
        """Return whether it was not seen for too long: a step of the drive, and longer the better it is known."""
        return passed > max(0.25 if len(self.steps) < YOUNG else 0.8, 1.5 * period)


def associate(
    clusters: Sequence[Sequence[Cluster]], seconds: Float64[np.ndarray, " t"], settings: TrackingSettings
) -> list[Chain]:
    """Return the chains of clusters of at least three instants, one list of clusters for each instant."""
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    going: list[_Open] = []
    done: list[_Open] = []
    for step, found in enumerate(clusters):
        cost = _costs(going, found, step, seconds, settings)
        taken = set()
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < NEVER:
                chain = going[row]
                chain.take(step, found[column], float(seconds[step] - seconds[chain.steps[-1]]))
                taken.add(int(column))
        going += [_Open(step, cluster) for number, cluster in enumerate(found) if number not in taken]
        lost = [chain.lost(float(seconds[step] - seconds[chain.steps[-1]]), period) for chain in going]
        done += [chain for chain, gone in zip(going, lost, strict=True) if gone]
        going = [chain for chain, gone in zip(going, lost, strict=True) if not gone]
    return [Chain(np.array(c.steps, np.int64), tuple(c.parts)) for c in done + going if len(c.steps) >= YOUNG]


def _costs(
    going: Sequence[_Open],
    found: Sequence[Cluster],
    step: int,
    seconds: Float64[np.ndarray, " t"],
    settings: TrackingSettings,
) -> Float64[np.ndarray, "g f"]:
    """Distance from where each chain should be, and unlikeness, in meters; ``NEVER`` beyond its gate."""
    cost = np.full((len(going), len(found)), NEVER)
    middles = np.array([cluster.middle for cluster in found]).reshape(-1, 2)
    extents = np.array([cluster.extent for cluster in found])
    for row, chain in enumerate(going):
        passed = float(seconds[step] - seconds[chain.steps[-1]])
        gap = np.linalg.norm(middles - chain.place - chain.velocity * passed, axis=1)
        unlike = np.abs(np.log((extents + 0.5) / (chain.extent + 0.5)))
        possible = (gap < chain.gate(passed, settings)) & (unlike < MAX_UNLIKE)
        cost[row, possible] = (gap + UNLIKE * unlike)[possible]
    return cost
