"""Terms of the loss that keep Gaussians and tracks in shape; pure functions, unweighted."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 5
"""Keyframes to either side that a pose is compared with, at most (DriveStudio draws one distance in 1 ... 5 a step)."""


def sharp_shape(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Mean of relu(log s_max - log s_min - log r): how far the axes of a Gaussian are more than r times apart.

    DriveStudio's term is linear in the ratio, which is not a number for a Gaussian that its mask hides (scale 0) and
    overflows for a needle; the logarithm of the unmasked scales does neither.
    """
    ratio = log_scales.amax(1) - log_scales.amin(1)
    return (ratio - math.log(max_axis_ratio)).relu().sum() / max(len(log_scales), 1)


def temporal_smoothness(
    times: Float[Tensor, "i k"], translations: Float[Tensor, "i k 3"], valid: Bool[Tensor, "i k"]
) -> Float[Tensor, ""]:
    """How far keyframes lie off the straight line between two others, in meters, as the mean of |t+ + t- - 2 t|.

    Over all objects, coordinates, keyframes and neighbors 1 to ``REACH`` keyframes before and after; gradients go to
    the keyframe in the middle alone. Where the three are not evenly spaced (frames are held out), the line is taken at
    the time of the middle one. This is what DriveStudio's term, of one frame and one distance a step, is on average.
    """
    count, device = times.shape[1], times.device
    middle, distance = torch.arange(count, device=device)[:, None], torch.arange(1, REACH + 1, device=device)
    before, after = middle - distance, middle + distance
    inside = (before >= 0) & (after < count)
    before, after = before.clamp(min=0), after.clamp(max=count - 1)
    # Valid keyframes come first: the last of three decides.
    whole = inside & valid[:, after]
    spans = torch.where(whole, times[:, after] - times[:, before], 1.0)
    fraction = (times[:, :, None] - times[:, before]) / spans
    fixed = translations.detach()
    line = torch.lerp(fixed[:, before], fixed[:, after], fraction[..., None])
    bends = 2 * (translations[:, :, None] - line).abs().mean(-1)
    return torch.where(whole, bends, 0.0).sum() / whole.sum().clamp(min=1)
