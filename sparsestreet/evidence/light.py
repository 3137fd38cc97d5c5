"""How dark, how noisy and how cut off the images are: what night, flare and a wrong exposure leave in them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from sparsestreet.data.lazy import Frames, spread
from sparsestreet.types import Frame

MOST_FRAMES = 36
WHITE = 250
"""Of 255: a pixel is cut off where red, green and blue have at least this; JPEG moves white by a few levels."""
_SECOND_DIFFERENCES = ((1.0, -2.0, 1.0), (-2.0, 4.0, -2.0), (1.0, -2.0, 1.0))


@dataclass(frozen=True)
class Light:
    """Over the images that were looked at; sky and recording car left out, where masks say what they are."""

    level: float
    """Of 255: the median image's mean gray level."""
    level_error: float
    noise: float
    """Gray levels of 255, standard deviation from pixel to pixel: of the median image."""
    clipped: float
    """Share of cut-off pixels."""
    clipped_error: float
    worst: float
    """Share of them in the image that has most, which is of ``worst_frame``."""
    worst_frame: int
    images: int


def measured_light(frames: Frames) -> Light:
    """Looks at a spread of the images. Errors are standard errors over images."""
    places = spread(len(frames), MOST_FRAMES)
    rows = np.array([_of(frames[place]) for place in places])
    levels, noise, clipped = rows.T
    worst, root = int(clipped.argmax()), np.sqrt(len(rows))
    return Light(
        float(np.median(levels)),
        # Of a median of normal values, pi / 2 times the variance of the mean.
        float(np.sqrt(np.pi / 2) * levels.std() / root),
        float(np.median(noise)),
        float(clipped.mean()),
        float(clipped.std() / root),
        float(clipped[worst]),
        frames.views[places[worst]].indices[0],
        len(rows),
    )


def _of(frame: Frame) -> tuple[float, float, float]:
    """Mean level, noise, and share of white pixels of one image; 128, 0 and 0 where nothing of it counts."""
    counts = torch.ones(frame.image.shape[:2], dtype=torch.bool)
    for mask in (frame.sky, frame.ego):
        counts &= torch.ones_like(counts) if mask is None else ~mask
    if not counts.any():
        return 128.0, 0.0, 0.0
    gray = frame.image.float().mean(-1)
    white = (frame.image >= WHITE).all(-1)[counts].float().mean()
    return float(gray[counts].mean()), _noise(gray), float(white)


def _noise(gray: Float[Tensor, "h w"]) -> float:
    """Of the differences that vanish on planes (Immerkaer 1996), whose weights have a squared sum of 36; the median of
    blocks, because edges are no noise."""
    differences = conv2d(gray[None, None], torch.tensor(_SECOND_DIFFERENCES)[None, None])[0, 0].abs()
    return float(differences.median()) * 1.4826 / 6
