"""Terms of the loss that keep Gaussians compact and tracks smooth; pure functions without weights."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 5
"""Most keyframes between a pose and those it is compared with (DriveStudio draws one distance of 1 ... 5 a step)."""


def sharp_shape(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Returns the mean of relu(log s_max - log s_min - log r), above 0 if axes differ by more than a factor r.

    DriveStudio's term is linear in the ratio. The ratio is not a number for a masked Gaussian (scale 0) and overflows
    for a needle; the logarithm of the unmasked scales does neither.

    >>> sharp_shape(torch.tensor([[0.0, 0.0, 0.0]]), max_axis_ratio=10.0).item()
    0.0
    """
    ratio = log_scales.amax(1) - log_scales.amin(1)
    return (ratio - math.log(max_axis_ratio)).relu().sum() / max(len(log_scales), 1)


def temporal_smoothness(
    times: Float[Tensor, "i k"], translations: Float[Tensor, "i k 3"], valid: Bool[Tensor, "i k"]
) -> Float[Tensor, ""]:
    """Returns how far keyframes lie off the straight line between two others, meters, as the mean of |t+ + t- - 2 t|.

    The mean is over all objects, coordinates, keyframes and neighbors 1 to ``REACH`` keyframes before and after.
    Gradients go only to the middle keyframe. If the three are not evenly spaced (frames are held out), the line is
    taken at the time of the middle one. DriveStudio's term, of one frame and one distance a step, equals this on
    average.

    >>> steady = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    >>> temporal_smoothness(torch.tensor([[0.0, 0.5, 1.0]]), steady, torch.ones(1, 3, dtype=torch.bool)).item()
    0.0
    """
    count, device = times.shape[1], times.device
    middle, distance = torch.arange(count, device=device)[:, None], torch.arange(1, REACH + 1, device=device)
    before, after = middle - distance, middle + distance
    inside = (before >= 0) & (after < count)
    before, after = before.clamp(min=0), after.clamp(max=count - 1)
    # Valid keyframes come first, so the last of three decides.
    whole = inside & valid[:, after]
    spans = torch.where(whole, times[:, after] - times[:, before], 1.0)
    fraction = (times[:, :, None] - times[:, before]) / spans
    fixed = translations.detach()
    line = torch.lerp(fixed[:, before], fixed[:, after], fraction[..., None])
    bends = 2 * (translations[:, :, None] - line).abs().mean(-1)
    return torch.where(whole, bends, 0.0).sum() / whole.sum().clamp(min=1)
