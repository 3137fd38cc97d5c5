"""Annotated poses of many objects, padded to one table, and which keyframes surround a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import Track, View

TIME_TOLERANCE = 1e-5
"""A tenth of a frame of a 10,000-frame log. Equal instants may differ by the rounding of frame / (frames - 1)."""


def frame_periods(views: Sequence[View]) -> float:
    """How many frames' worth normalized time 0 to 1 is, by the first view of each frame: frames - 1 if they are even.

    >>> from sparsestreet.types import Camera
    >>> camera = Camera(torch.eye(4), torch.eye(3), width=8, height=6)
    >>> frame_periods([View(camera, 0.0, 0, 0), View(camera, 0.2, 0, 1), View(camera, 0.8, 4, 0)])
    5.0
    """
    first: dict[int, float] = {}
    for view in views:
        index, _ = view.indices
        first[index] = min(view.time, first.get(index, view.time))
    start, end = min(first, default=0), max(first, default=0)
    return (end - start) / (first[end] - first[start]) if start < end else 1.0


@dataclass(frozen=True)
class Trajectories:
    """World-from-box poses at annotated instants. Row i is object i, its valid keyframes first, in order of time."""

    times: Float[Tensor, "i k"]
    """Normalized time; 0 where not valid."""
    quaternions: Float[Tensor, "i k 4"]
    translations: Float[Tensor, "i k 3"]
    """Box center in the world, meters."""
    valid: Bool[Tensor, "i k"]
    spans: Float[Tensor, "i 2"]
    """From when to when the object is there: of the first and last annotated frame, held-out ones included."""

    @staticmethod
    def from_tracks(tracks: Sequence[Track], held_out: frozenset[int], num_frames: int) -> "Trajectories":
        """The tracks' annotations without those of held-out frames, float32; ``num_frames`` is that of the log.

        Raises ValueError if a track keeps no annotation.

        >>> poses = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
        >>> car = Track("car", "vehicle", torch.tensor([0, 1, 2]), poses, torch.tensor([4.0, 2.0, 1.5]))
        >>> Trajectories.from_tracks([car], held_out=frozenset({2}), num_frames=5).times
        tensor([[0.0000, 0.2500]])
        """
        counts = [sum(int(frame) not in held_out for frame in track.frames) for track in tracks]
        for track, count in zip(tracks, counts, strict=True):
            if count == 0:
                raise ValueError(
                    f"every track needs a pose in a training frame, but {track.name!r} is annotated only in "
                    f"held-out frames {track.frames.tolist()}: leave the track out or hold out fewer frames"
                )
        shape = (len(tracks), max(counts, default=1))
        times, valid = torch.zeros(shape), torch.zeros(shape, dtype=torch.bool)
        rotations, translations = torch.zeros(*shape, 4), torch.zeros(*shape, 3)
        rotations[..., 0] = 1
        spans = torch.zeros(shape[0], 2)
        last_frame = max(num_frames - 1, 1)
        for i, (track, count) in enumerate(zip(tracks, counts, strict=True)):
            kept = torch.tensor([int(frame) not in held_out for frame in track.frames], dtype=torch.bool)
            poses = track.world_from_object[kept]
            instants = track.frames.double() / last_frame if track.times is None else track.times
            times[i, :count] = instants[kept].float()
            rotations[i, :count] = quat.from_matrix(poses[:, :3, :3]).float()
            translations[i, :count] = poses[:, :3, 3].float()
            valid[i, :count] = True
            spans[i] = instants[[0, -1]] if track.span is None else torch.tensor(track.span, dtype=torch.float64)
        return Trajectories(times, rotations, translations, valid, spans)


@dataclass(frozen=True)
class KeyframeInterval:
    """Which two keyframes a query lies between, per object."""

    lower: Int[Tensor, " i"]
    upper: Int[Tensor, " i"]
    fraction: Float[Tensor, " i"]
    """0 at the lower keyframe, 1 at the upper; outside [0, 1] where the pose is extrapolated."""
    active: Bool[Tensor, " i"]


def keyframe_interval(
    times: Float[Tensor, "i k"],
    valid: Bool[Tensor, "i k"],
    spans: Float[Tensor, "i 2"],
    time: float,
    max_gap: float,
) -> KeyframeInterval:
    """The keyframes around ``time``. An object is active within its annotated span, if a keyframe is near enough.

    Args:
        max_gap: largest distance in time to the nearest keyframe at which an object is active.

    A held-out end of a span lies beyond the last keyframe. There the first or last two keyframes are extrapolated at
    constant velocity, up to the end of the span.

    >>> times, spans = torch.tensor([[0.0, 0.4, 0.8]]), torch.tensor([[0.0, 0.8]])
    >>> at = keyframe_interval(times, torch.ones(1, 3, dtype=torch.bool), spans, time=0.5, max_gap=0.2)
    >>> at.lower, at.upper, at.fraction, at.active
    (tensor([1]), tensor([2]), tensor([0.2500]), tensor([True]))
    """
    count = valid.sum(1)
    num_before = (valid & (times <= time)).sum(1)
    lower = torch.minimum((num_before - 1).clamp(min=0), (count - 2).clamp(min=0))
    upper = torch.minimum(lower + 1, count - 1)
    time_lower, time_upper = (times.gather(1, keyframe[:, None]).squeeze(1) for keyframe in (lower, upper))
    inside = torch.full_like(time_lower, time).clamp(spans[:, 0], spans[:, 1])
    step = torch.where(upper > lower, time_upper - time_lower, torch.ones_like(time_lower))
    fraction = torch.where(upper > lower, (inside - time_lower) / step, torch.zeros_like(step))
    nearest = torch.where(valid, (times - time).abs(), torch.inf).amin(1)
    active = (nearest <= max_gap + TIME_TOLERANCE) & ((inside - time).abs() <= TIME_TOLERANCE)
    return KeyframeInterval(lower, upper, fraction, active)


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
