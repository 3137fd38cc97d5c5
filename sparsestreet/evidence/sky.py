"""How much of the images is sky, by the log's masks."""

from dataclasses import dataclass

import torch

from sparsestreet.data.lazy import Frames, spread

MOST_FRAMES = 36


@dataclass(frozen=True)
class SkyShare:
    """Of all pixels of the images that were looked at."""

    share: float
    error: float
    """Standard error, by images."""
    frames: int


def sky_share(frames: Frames) -> SkyShare | None:
    """The share of sky in images spread over the drive; None where they have no masks."""
    masks = (frames[place].sky for place in spread(len(frames), MOST_FRAMES))
    shares = torch.tensor([float(mask.float().mean()) for mask in masks if mask is not None])
    if not len(shares):
        return None
    error = float(shares.std() / len(shares) ** 0.5) if len(shares) > 1 else 0.0
    return SkyShare(float(shares.mean()), error, len(shares))
