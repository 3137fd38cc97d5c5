"""The gait that the returns of a lidar show best."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.optimize import least_squares
from torch import Tensor

from sparsestreet.geometry.capsules import Capsules
from sparsestreet.geometry.skeleton import HEIGHT, NUM_JOINTS, posed_bones, rest_joints
from sparsestreet.tracking.gait import Gait, Walk, usual_curves

MIN_RETURNS = 30
"""Below these the usual gait is taken, as nothing says more."""
_OFF = 0.05
"""Standard deviation of a return from the body's surface, meters; one much farther off counts less."""
_SHIFTED = 0.08
"""Standard deviation of the body's place in its box, meters."""
_UNUSUAL = np.radians(8.0)
"""Standard deviation of each term of a person's curves from the usual ones, radians."""
_UNPACED = 0.1
"""Standard deviation of the logarithm of the pace."""
_NUMBERS = 30
"""Phase, radians; then in standard deviations pace, place of the body (3), and curves (25)."""
_PHASES, _PACES = 32, np.linspace(-3, 3, 25)
"""How many phases, and which paces in standard deviations, are tried first."""
_STEP = 1e-5
"""Of finite differences."""


def gait_of(numbers: Float64[np.ndarray, "k p"]) -> Gait:
    """Return the gaits that the numbers of a fit describe; zeros are the usual one."""
    values = torch.from_numpy(numbers)
    curves = usual_curves() + _UNUSUAL * values[:, 5:].unflatten(1, (5, 5))
    return Gait(curves, values[:, 0], (_UNPACED * values[:, 1]).exp())


@dataclass(frozen=True)
class Seen:
    """What lidars saw of a person: n returns at m moments."""

    points: Float64[Tensor, "n 3"]
    """In the frame of the body at rest, which stands on the lower side of the box; meters."""
    moments: Int64[Tensor, " n"]
    """Number of the moment of each return."""
    walk: Walk
    """At these moments."""
    height: float
    """Of the person, meters."""

    def gait(self) -> Gait:
        """Return the likeliest gait, a body in any place near the middle of its box, and curves near the usual ones."""
        if len(self.points) < MIN_RETURNS:
            return gait_of(np.zeros((1, _NUMBERS)))
        first, ends = self._tried(), []
        slopes: Any = self._slopes  # of functions scipy's types know nothing
        # Seen from the side, a body half a stride later looks much the same.
        for later in (0.0, np.pi):
            start = first + later * np.eye(_NUMBERS)[0]
            ends.append(least_squares(self._residuals, start, slopes, loss="soft_l1", max_nfev=30))
        return gait_of(min(ends, key=lambda end: end.cost).x[None])

    def _tried(self) -> Float64[np.ndarray, " p"]:
        """Return the numbers of phase and pace at which the usual gait is nearest to the returns."""
        numbers = np.zeros((_PHASES, _NUMBERS))
        numbers[:, 0] = 2 * np.pi * np.arange(_PHASES) / _PHASES
        once, none = Walk(*np.array([[0.0], [0.0], [1.0]])), torch.zeros_like(self.moments)
        off, _ = self._surface(numbers, none, once)
        # As of soft_l1: [n, phases]
        costs = 2 * (np.sqrt(1 + (off.numpy().T / _OFF) ** 2) - 1) * self.walk.swing[self.moments, None]
        best = np.inf, numbers[0]
        for pace in _PACES:
            place = _PHASES * np.exp(_UNPACED * pace) * self.walk.strides[self.moments]
            nearest = (np.rint(place).astype(int)[:, None] + np.arange(_PHASES)) % _PHASES
            sums = np.take_along_axis(costs, nearest, 1).sum(0) + pace**2
            if sums.min() < best[0]:
                numbers[:, 1] = pace
                best = sums.min(), numbers[sums.argmin()].copy()
        return best[1]

    def _residuals(self, numbers: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, " r"]:
        off, _ = self._surface(numbers[None], self.moments, self.walk)
        return np.concatenate((off[0].numpy() / _OFF, numbers[1:]))

    def _slopes(self, numbers: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, "r p"]:
        """Return the derivatives of the residuals; a small step leads to no other capsule."""
        _, nearest = self._surface(numbers[None], self.moments, self.walk)
        around = numbers + _STEP * np.eye(_NUMBERS + 1, _NUMBERS, -1)
        off, _ = self._surface(around, self.moments, self.walk, nearest)
        slopes = (off[1:] - off[0]).numpy().T / (_STEP * _OFF)
        return np.concatenate((slopes, np.eye(_NUMBERS)[1:]))

    def _surface(
        self,
        numbers: Float64[np.ndarray, "k p"],
        moments: Int64[Tensor, " n"],
        walk: Walk,
        nearest: Int64[Tensor, "1 n"] | None = None,
    ) -> tuple[Float64[Tensor, "k n"], Int64[Tensor, "* n"]]:
        """Return how far each return is outside of k bodies, meters, and its nearest capsule, unless that is known."""
        capsules, scale = Capsules.of_body(), self.height / HEIGHT
        owners, radii = torch.from_numpy(capsules.joints), scale * torch.from_numpy(capsules.radii)
        ends = scale * torch.from_numpy(np.stack((capsules.starts, capsules.ends), -1))
        joints = gait_of(numbers).joints(walk)
        rest = scale * rest_joints().double().expand(joints[..., 0, 0].numel(), NUM_JOINTS, 3)
        bones = posed_bones(rest, joints.flatten(0, 1)).transforms.unflatten(0, joints.shape[:2])
        points = (self.points - _SHIFTED * torch.from_numpy(numbers[:, None, 2:5]))[:, :, None]
        # Of all capsules, or of the nearest alone.
        each = torch.arange(len(radii)).expand(1, len(radii)) if nearest is None else nearest[0][:, None]
        if nearest is None:
            own = bones[:, :, owners]
            starts, stops = (own[..., :3] @ ends + own[..., 3:]).unbind(-1)
            starts, stops = starts[:, moments], stops[:, moments]
        else:
            own = bones[:, moments[:, None], owners[each]]
            starts, stops = (own[..., :3] @ ends[each] + own[..., 3:]).unbind(-1)
        axes, reach = stops - starts, points - starts
        along = ((reach * axes).sum(-1) / axes.square().sum(-1)).clamp(0, 1)
        off = (reach - along[..., None] * axes).norm(dim=-1) - radii[each]
        if nearest is not None:
            return off[..., 0], nearest
        return off.min(-1)
