"""Dirt on a camera's lens, found where nobody declares it: dark spots that stay while the street passes."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, label, uniform_filter
from torch import Tensor

from sparsestreet.data.followed import FollowedReturns, followed_returns
from sparsestreet.data.hood import LEAST_DRIVE, MOST_FRAMES, Hood, driven
from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.types import Track

_STILL = 6.0
"""Gray levels of 255: the median change of a pixel behind a spot. What passes is dimmed, not hidden."""
_DARKER = 12.0
"""Gray levels by which a spot is darker than what is around it, in the median image."""
_AROUND = 0.25
"""Of the image's width: a spot is compared with the mean of a square of this side, and is smaller than it."""
_FEWEST = 8
"""Pixels of a spot, and returns that are followed out of it."""
_CHANGES = 0.2
"""Change of the gray level at a return's old pixel, over that at its new one, below which it was a spot that was seen:
0.01 to 0.13 of planted ones. Curbs and joints along the road, which stay the same too, have 0.3 and more."""
_SOFT = 0.5
"""Of a spot's radius: so far beyond its dark middle it is masked."""


def find_dirt(frames: Frames, sweeps: Sweeps, tracks: Sequence[Track]) -> dict[int, Hood]:
    """Camera index -> the spots that its images show, of the cameras that moved; an empty mask where there are none.

    Curbs and road below them stay the same too. So a spot counts where returns of the lidar that are followed out of it
    change their gray level, and the pixels that they leave do not. Without lidar nothing is found.
    """
    found = {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        if driven(own) < LEAST_DRIVE:
            continue
        seen = [own[place] for place in spread(len(own), MOST_FRAMES)]
        gray = torch.stack([frame.image.float().mean(-1) for frame in seen])
        told = torch.ones(gray.shape[1:], dtype=torch.bool)
        for frame in seen:
            for mask in (frame.sky, frame.ego):
                told &= torch.ones_like(told) if mask is None else ~mask
        returns = list(followed_returns(own, sweeps, tracks))
        masks = [_spots(part, told, returns) for part in (gray, gray[::2], gray[1::2])]
        even, odd = (float(mask.float().mean()) for mask in masks[1:])
        found[camera] = Hood(masks[0], abs(even - odd) / 2)
    return found


def _spots(
    gray: Float[Tensor, "f h w"], told: Bool[Tensor, "h w"], returns: Sequence[FollowedReturns]
) -> Bool[Tensor, "h w"]:
    levels = gray.mean((1, 2), keepdim=True)
    gray = gray * levels.median() / levels.clamp(min=1.0)  # exposure may change
    middle = gray.median(0).values
    still = (gray - middle).abs().median(0).values < _STILL
    side = round(_AROUND * middle.shape[1]) | 1
    around = torch.from_numpy(uniform_filter(middle.numpy(), side, mode="nearest"))
    places = np.empty(middle.shape, np.int32)
    dark = (still & told & (middle < around - _DARKER)).numpy()
    count = int(label(dark, output=places))  # pyright: ignore[reportArgumentType]: with an output it returns the number
    mask = np.zeros(middle.shape, dtype=bool)
    for spot in _whole(places, count, side):
        if _hides(torch.from_numpy(spot), returns):
            mask |= binary_dilation(spot, iterations=max(round(_SOFT * np.sqrt(spot.sum() / np.pi)), 1))
    return torch.from_numpy(mask)


def _hides(spot: Bool[Tensor, "h w"], returns: Sequence[FollowedReturns]) -> bool:
    """Whether what is followed out of the spot looks another way, and the spot does not."""
    leave = [spot[each.old] & ~spot[each.new] for each in returns]
    if sum(int(some.sum()) for some in leave) < _FEWEST:
        return False
    stayed, moved = (
        float(torch.cat([part[some] for part, some in zip(parts, leave, strict=True)]).mean())
        for parts in ([each.stayed for each in returns], [each.moved for each in returns])
    )
    return stayed < _CHANGES * moved


def _whole(places: np.ndarray, count: int, side: int) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Spots of enough pixels that are no line and no larger than what they are compared with."""
    for number in range(1, count + 1):
        spot = places == number
        rows, columns = np.nonzero(spot)
        height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
        if len(rows) >= _FEWEST and max(height, width) <= min(side, 3 * min(height, width)):
            yield spot
