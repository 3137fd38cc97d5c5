"""Smooth paths through poses that are each a little off."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.trajectories import Trajectories

FEWEST = 6
"""Keyframes of an object; through fewer any path is smooth."""
_SMOOTHNESS = np.logspace(-2, 8, 61)
"""Of which one is chosen; a step between keyframes is 1."""
_PRICE = 1.4
"""Of a degree of freedom: with 1, cross-validation now and then keeps the errors of short paths (Kim and Gu 2004)."""
_WIDEST = 2.5
"""Radians from the middle keyframe: an object that turns further keeps its rotations, which have no axis there."""


def smoothed(keyframes: Trajectories) -> tuple[Float[Tensor, "i k 3"], Float[Tensor, "i k 3"]]:
    """Corrections that move each object's keyframes to a smooth path: rotation vectors in its frame, and meters.

    Cubic smoothing splines. How smooth they are, generalized cross-validation says (Craven and Wahba 1978): each
    keyframe as foretold by the others. Exact boxes of a car stay where they are, to a millimeter.

    >>> times = torch.linspace(0, 1, 8)[None]
    >>> still = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, 8, 4)
    >>> there = torch.ones(1, 8, dtype=torch.bool)
    >>> even = 20 * times[..., None] * torch.tensor([1.0, 0.0, 0.0])
    >>> rotations, translations = smoothed(Trajectories(times, still, even, there, torch.tensor([[0.0, 1.0]])))
    >>> bool(translations.abs().max() < 1e-3), bool(rotations.abs().max() < 1e-3)
    (True, True)
    """
    rotations, translations = torch.zeros_like(keyframes.translations), torch.zeros_like(keyframes.translations)
    for number, valid in enumerate(keyframes.valid):
        if int(valid.sum()) >= FEWEST:
            times = keyframes.times[number, valid].double().numpy()
            recorded = keyframes.translations[number, valid].double().numpy()
            translations[number, valid] = torch.from_numpy(_spline(times, recorded) - recorded).float()
            rotations[number, valid] = _turns(times, keyframes.quaternions[number, valid])
    return rotations, translations


def _turns(times: Float[np.ndarray, " k"], recorded: Float[Tensor, "k 4"]) -> Float[Tensor, "k 3"]:
    middle = recorded[len(recorded) // 2].double().expand(len(recorded), 4)
    turned = quat.to_rotation_vector(quat.multiply(_conjugate(middle), recorded.double()))
    if float(turned.norm(dim=1).max()) > _WIDEST:
        return torch.zeros(len(recorded), 3)
    wanted = quat.multiply(middle, quat.from_rotation_vector(torch.from_numpy(_spline(times, turned.numpy()))))
    return quat.to_rotation_vector(quat.multiply(_conjugate(recorded.double()), wanted)).float()


def _conjugate(quaternions: Float[Tensor, "k 4"]) -> Float[Tensor, "k 4"]:
    return quaternions * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quaternions.dtype)


def _spline(times: Float[np.ndarray, " k"], values: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "k c"]:
    """The natural cubic smoothing spline at its knots (Reinsch 1967), of one smoothness for all columns.

    With the roughness K = U diag(d) U^T it is U diag(1 / (1 + s d)) U^T values. Of the s that are tried, the one with
    the least (residuals)^2 / (k - 1.4 degrees of freedom)^2 counts.
    """
    steps = np.diff(times) * (len(times) - 1) / (times[-1] - times[0])
    differences, gram = np.zeros((len(times), len(times) - 2)), np.zeros((len(times) - 2,) * 2)
    for k in range(len(times) - 2):
        before, after = steps[k], steps[k + 1]
        differences[k : k + 3, k] = 1 / before, -1 / before - 1 / after, 1 / after
        gram[k, k] = (before + after) / 3
        if k:
            gram[k, k - 1] = gram[k - 1, k] = before / 6
    roughness, axes = np.linalg.eigh(differences @ np.linalg.solve(gram, differences.T))
    along = axes.T @ values
    kept = 1 / (1 + _SMOOTHNESS[:, None] * np.maximum(roughness, 0))
    left = len(times) - _PRICE * kept.sum(1)
    scores = np.where(left > 0, np.square((1 - kept)[:, :, None] * along).sum((1, 2)), np.inf) / np.square(left)
    return axes @ (kept[scores.argmin()][:, None] * along)
