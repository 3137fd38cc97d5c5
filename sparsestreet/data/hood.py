"""The recording car in its own images, found where nobody declares it: rows at the bottom that never change."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter
from torch import Tensor

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.types import Frame

MOST_FRAMES = 40
"""Of a camera; a hundred megabytes at 960x640."""
LEAST_DRIVE = 20.0
"""Meters the camera has to move, so that the street has changed in every image."""
LEAST_WIDTH = 0.25
"""Share of the image's columns in which a hood is seen. Smooth road over a straight line looks like one in up to 8 % of
the columns of synthetic streets."""
_STILL = 4.0
"""Gray levels of 255: the median change of a pixel that shows the same."""
_EDGE = 8.0
"""Gray levels across the hood's upper edge, in the median image."""
_SAME = 0.7
"""Share of the edges of single images that the median image keeps; a moving edge is blurred."""


@dataclass(frozen=True)
class Hood:
    """What one camera sees of the car that carries it."""

    mask: Bool[Tensor, "h w"]
    error: float
    """Half the difference between the shares of the image that even and odd images give."""

    @property
    def share(self) -> float:
        """Of the image."""
        return float(self.mask.float().mean())


def find_hoods(frames: Frames) -> dict[int, Hood]:
    """Camera index -> what it sees of its car, of the cameras that moved; an empty mask where it sees nothing of it."""
    found = {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        if _driven(own) >= LEAST_DRIVE:
            gray = torch.stack([own[place].image.float().mean(-1) for place in spread(len(own), MOST_FRAMES)])
            shares = [float(_below_a_still_edge(part).float().mean()) for part in (gray[::2], gray[1::2])]
            found[camera] = Hood(_below_a_still_edge(gray), abs(shares[0] - shares[1]) / 2)
    return found


def with_hoods(frames: Frames, hoods: dict[int, Hood]) -> Frames:
    """The frames with the hoods among their ``ego`` pixels; they are read as before, when they are indexed."""
    seen = {camera: hood.mask for camera, hood in hoods.items() if hood.mask.any()}
    if not seen:
        return frames

    def load(view: Frame) -> Frame:
        frame, mask = frames.load(view), seen.get(view.indices[1])
        if mask is None:
            return frame
        return replace(frame, ego=mask if frame.ego is None else mask | frame.ego)

    return Frames(frames.keys, load)


def _driven(frames: Frames) -> float:
    """Meters along the path of a camera."""
    centers = torch.stack([view.camera.position for view in frames.views])
    return float((centers[1:] - centers[:-1]).norm(dim=1).sum())


def _below_a_still_edge(gray: Float[Tensor, "f h w"]) -> Bool[Tensor, "h w"]:
    """Pixels that stay the same down to the lower border, below an edge that stays as well, where it is wide enough."""
    middle = gray.median(0).values
    still = (gray - middle).abs().median(0).values < _STILL
    rows = still.flip(0).cumprod(0).flip(0).bool()  # still, and all pixels below
    edge = torch.zeros_like(rows)
    slope = (middle[2:] - middle[:-2]).abs()
    edge[1:-1] = (slope > _EDGE) & (slope > _SAME * (gray[:, 2:] - gray[:, :-2]).abs().median(0).values)
    height, width = rows.shape
    tops, columns = height - rows.sum(0), torch.arange(width)
    near = torch.stack([edge[(tops + offset).clamp(0, height - 1), columns] for offset in (-1, 0, 1, 2)])
    ends = near.any(0) & (tops < height - 1) & (tops > 1)
    if float(ends.float().mean()) < LEAST_WIDTH:
        return torch.zeros_like(rows)
    # A column whose reflection or road hides the edge is like its neighbors; the row of the edge itself is half street.
    found = columns[ends].numpy()
    line = median_filter(np.interp(columns.numpy(), found, tops[ends].numpy()), max(width // 20, 9), mode="nearest")
    inside = (columns >= int(found[0])) & (columns <= int(found[-1]))
    return (torch.arange(height)[:, None] >= torch.from_numpy(line).floor() - 1) & inside
