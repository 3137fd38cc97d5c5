"""How people walk: the angles of their joints over a stride, how long it is, and where in it a person is."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.skeleton import JOINTS, NUM_JOINTS

_DEGREES = (
    (25, 22, 14, 4, -6, -13, -8, 8, 22, 28),
    (5, 17, 15, 8, 6, 15, 40, 60, 40, 8),
    (0, -3, 5, 8, 10, 5, -18, -8, 0, 0),
    (-20, -17, -10, -2, 5, 8, 5, -2, -10, -17),
    (15, 17, 23, 31, 37, 39, 37, 31, 23, 17),
)
"""Flexion at each tenth of a stride: the usual course of normal walking at a person's own pace, as in textbooks of gait
analysis (Winter 1991; Perry and Burnfield 2010), rounded. Arms swing against the legs."""
_DOWN = np.radians(80.0)
"""Of the arms, from where they are stretched out sideways."""
_WALK_RATIO = 0.0065
"""Meters a step for each step a minute, whatever the speed (Sekiya and Nagasaki 1998), at a height of 1.7 m."""
_STANDS, _WALKS = 0.15, 0.6
"""Meters per second below which nothing swings, and from which all swings as usual."""
_SMOOTH = 0.3
"""Standard deviation of the window in which a speed is measured, seconds."""


_SIDES = {"left": (0.0, 1), "right": (np.pi, -1)}
"""Phase of its leg when that of the left one is 0, and where it is along the body's x."""


def _waves(phase: Float64[Tensor, "*b"]) -> Float64[Tensor, "*b 5"]:
    parts = (torch.ones_like(phase), phase.cos(), phase.sin(), (2 * phase).cos(), (2 * phase).sin())
    return torch.stack(parts, -1)


def usual_curves() -> Float64[Tensor, "5 5"]:
    """Return the usual gait, in the terms of ``Gait.curves``."""
    phase = 2 * torch.pi * torch.arange(10, dtype=torch.float64) / 10
    return torch.deg2rad(torch.tensor(_DEGREES, dtype=torch.float64)) @ _waves(phase) / torch.tensor([10, 5, 5, 5, 5])


@dataclass(frozen=True)
class Gait:
    """How k people walk, each with the same curves on both sides."""

    curves: Float64[Tensor, "k 5 5"]
    """Flexion of hip, knee, ankle, shoulder and elbow: mean, cosine and sine of the phase and of twice the phase,
    radians. Phase 0 is when the foot of the joint's own side strikes the ground."""
    phase: Float64[Tensor, " k"]
    """Of the left foot at the first moment, radians."""
    pace: Float64[Tensor, " k"]
    """Strides for each one that is expected of the speed."""

    def joints(self, walk: "Walk") -> Float64[Tensor, "k f 24 4"]:
        """Return the rotations of joints relative to their parents at the moments of a walk, the pelvis at rest."""
        strides, swing = torch.from_numpy(walk.strides), torch.from_numpy(walk.swing)
        phase = self.phase[:, None] + 2 * torch.pi * self.pace[:, None] * strides
        turns = torch.zeros(*phase.shape, NUM_JOINTS, 4, dtype=torch.float64)
        turns[..., 0] = 1
        for side, (later, outwards) in _SIDES.items():
            flexion = swing[:, None] * (_waves(phase + later) @ self.curves.mT)
            hip, knee, ankle, shoulder, elbow = flexion.unbind(-1)
            # Ahead is from -y to z of a leg, from x or -x to z of a forearm in the frame of its arm.
            down = _about(2, torch.full_like(shoulder, -outwards * _DOWN))
            posed = {"hip": _about(0, -hip), "knee": _about(0, knee), "ankle": _about(0, -ankle)}
            posed |= {"shoulder": quat.multiply(_about(0, -shoulder), down), "elbow": _about(1, -outwards * elbow)}
            for joint, turn in posed.items():
                turns[:, :, JOINTS.index(f"{side}_{joint}")] = turn
        return turns


def _about(axis: int, angle: Float64[Tensor, "*b"]) -> Float64[Tensor, "*b 4"]:
    vectors = torch.zeros(*angle.shape, 3, dtype=angle.dtype)
    vectors[..., axis] = angle
    return quat.from_rotation_vector(vectors)


@dataclass(frozen=True)
class Walk:
    """How a person moves along: when, how far in strides, and how much of a gait is seen."""

    seconds: Float64[np.ndarray, " f"]
    strides: Float64[np.ndarray, " f"]
    """Made since the first moment, as expected of the speed."""
    swing: Float64[np.ndarray, " f"]
    """From 0, standing, to 1."""

    @staticmethod
    def along(seconds: Float64[np.ndarray, " f"], places: Float64[np.ndarray, "f 2"], height: float) -> "Walk":
        """Return the walk of a person of this height through these places in plan, meters.

        A stride is two steps, each sqrt(60 walk_ratio speed): a step is the speed times its duration, and the walk
        ratio is that of a step to the number of steps a minute.
        """
        speed = np.linalg.norm(_velocity(seconds, places), axis=1)
        rate = speed / (2 * np.sqrt(60 * _WALK_RATIO * (height / 1.7) * np.maximum(speed, _STANDS)))
        swing = np.clip((speed - _STANDS) / (_WALKS - _STANDS), 0, 1)
        steps = np.diff(seconds) * (rate[1:] + rate[:-1]) / 2
        return Walk(seconds, np.concatenate(([0.0], np.cumsum(steps))), swing)

    def at(self, seconds: Float64[np.ndarray, " n"]) -> "Walk":
        """Return it at other moments; as at the first or last moment beyond these."""
        strides, swing = (np.interp(seconds, self.seconds, values) for values in (self.strides, self.swing))
        return Walk(seconds, strides, swing)


def _velocity(seconds: Float64[np.ndarray, " f"], places: Float64[np.ndarray, "f 2"]) -> Float64[np.ndarray, "f 2"]:
    """Return the slope of a line through the places around each moment; 0 of one place alone."""
    weights = np.exp(-0.5 * ((seconds[:, None] - seconds) / _SMOOTH) ** 2)
    # The nearest other place counts whatever the gap.
    weights = np.maximum(weights, 1e-6)
    weights /= weights.sum(1, keepdims=True)
    apart = seconds - (weights @ seconds)[:, None]
    spread = (weights * apart**2).sum(1, keepdims=True)
    return ((weights * apart) @ places) / np.where(spread > 0, spread, 1.0)
