"""Terms of the loss that keep Gaussians compact and tracks smooth; pure functions without weights."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 5
"""Most keyframes between a pose and those it is compared with (DriveStudio draws one distance of 1 ... 5 a step)."""


def sharp_shape(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Returns the mean of relu(log s_max - log s_min - log r), above 0 if axes differ by more than a factor r.

    DriveStudio's term, ``sharp_shape_ratio``, is linear in the ratio. The ratio overflows for a needle, and its
    gradient grows with it; the logarithm does neither.

    >>> sharp_shape(torch.tensor([[0.0, 0.0, 0.0]]), max_axis_ratio=10.0).item()
    0.0
    """
    ratio = log_scales.amax(1) - log_scales.amin(1)
    return (ratio - math.log(max_axis_ratio)).relu().sum() / max(len(log_scales), 1)


def sharp_shape_ratio(log_scales: Float[Tensor, "n 3"], max_axis_ratio: float) -> Float[Tensor, ""]:
    """Returns the mean of max(s_max / s_min, r) - r, DriveStudio's term against needles.

    >>> sharp_shape_ratio(torch.tensor([[12.0, 1.0, 1.0], [2.0, 1.0, 1.0]]).log(), max_axis_ratio=10.0).item()
    1.0
    """
    ratio = (log_scales.amax(1) - log_scales.amin(1)).exp()
    return (ratio - max_axis_ratio).relu().sum() / max(len(log_scales), 1)


def excess_volume(log_scales: Float[Tensor, "n 3"], quantile: float) -> Float[Tensor, ""]:
    """Returns the mean of relu(v - p) of the products v of the scales, cubic meters, and p their quantile.

    p is the floor(quantile n)-th smallest of them, and is differentiated too, as in DriveStudio.

    >>> excess_volume(torch.tensor([[1.0], [2.0], [3.0], [6.0]]).log().expand(4, 3) / 3, quantile=0.75).item()
    0.75
    """
    volumes = log_scales.sum(1).exp()
    rank = int(len(volumes) * quantile)
    if rank < 1:
        return volumes.new_zeros(())
    return (volumes - torch.kthvalue(volumes, rank).values).relu().mean()


def temporal_smoothness_at(
    times: Float[Tensor, "i k"],
    translations: Float[Tensor, "i k 3"],
    valid: Bool[Tensor, "i k"],
    time: float,
    distance: int,
) -> Float[Tensor, ""]:
    """Returns the part of ``temporal_smoothness`` of the keyframes at one time and their neighbors at one distance.

    The mean is over the objects that have all three keyframes. DriveStudio's term of a step: the time is that of its
    view, the distance is drawn. A keyframe is that of a time up to half of the shortest step between keyframes away,
    because cameras have instants of their own. 0 if no object has all three.

    >>> jerk = torch.tensor([[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    >>> whole = torch.ones(1, 3, dtype=torch.bool)
    >>> temporal_smoothness_at(torch.tensor([[0.0, 0.5, 1.0]]), jerk, whole, time=0.5, distance=1).item()
    2.0
    """
    count = times.shape[1]
    here = (times - time).abs().masked_fill(~valid, torch.inf)
    each, middle = torch.arange(len(times), device=times.device), here.argmin(1)
    before, after = middle - distance, middle + distance
    steps = torch.where(valid[:, 1:], times[:, 1:] - times[:, :-1], torch.inf)
    # Just above a half: a camera may fire in the middle of two boxes.
    near = here.amin(1) < 0.501 * torch.nn.functional.pad(steps, (0, 1), value=torch.inf).amin()
    whole = near & (before >= 0) & (after < count)
    before, after = before.clamp(min=0), after.clamp(max=count - 1)
    # Valid keyframes come first, so the last of three decides.
    whole = whole & valid[each, after]
    span = torch.where(whole, times[each, after] - times[each, before], 1.0)
    fraction = (times[each, middle] - times[each, before]) / span
    fixed = translations.detach()
    line = torch.lerp(fixed[each, before], fixed[each, after], fraction[:, None])
    bends = 2 * (translations[each, middle] - line).abs().mean(-1)
    return torch.where(whole, bends, 0.0).sum() / whole.sum().clamp(min=1)


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
