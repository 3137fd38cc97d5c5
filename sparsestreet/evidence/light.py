"""Measure how dark, noisy and clipped the images are: night, flare or a wrong exposure."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from sparsestreet.data.images import WHITE
from sparsestreet.data.lazy import Frames, spread
from sparsestreet.kept import NOTHING, Kept
from sparsestreet.types import Frame

MAX_FRAMES = 36
MIN_STOPS = 1.25
"""Stops of the stored values below middle gray from which a log is dark: a mean gray level of 50 of 255."""
MIN_CLIPPED = 0.02
"""Share of clipped pixels, of those that are not sky, from which a log is doubted."""
_MIDDLE_GRAY = 118.0
"""Gray level of 255 that an exposure control aims at: 18 % of the light, in sRGB."""
_SECOND_DIFFERENCES = ((1.0, -2.0, 1.0), (-2.0, 4.0, -2.0), (1.0, -2.0, 1.0))


@dataclass(frozen=True)
class Light:
    """Over the images that were looked at; sky and recording car left out, where masks say what they are."""

    level: float
    """Of 255: the median image's mean gray level."""
    noise: float
    """Gray levels of 255, standard deviation from pixel to pixel: of the median image."""
    clipped: float
    """Share of cut-off pixels."""
    worst: float
    """Share of them in the image that has most, which is of ``worst_frame``."""
    worst_frame: int
    images: int

    @property
    def stops(self) -> float:
        """Stop of the stored values by which the median image lies below middle gray."""
        return math.log2(_MIDDLE_GRAY / max(self.level, 0.5))

    def numbers(self) -> dict[str, float]:
        """Return what ``run.json`` keeps, by name."""
        return {
            "stops_below_middle_gray": self.stops,
            "mean_gray_level": self.level,
            "noise_gray_levels": self.noise,
            "clipped_share": self.clipped,
            "clipped_share_of_worst_image": self.worst,
        }


def light_warnings(light: Light) -> Iterator[str]:
    """Yield one sentence for each thing about the light that no scene simulates in full."""
    if light.stops >= MIN_STOPS:
        yield (
            f"{light.images} images have a mean gray level of {light.level:.0f} of 255, and a noise of "
            f"{light.noise:.1f} levels: they are dark, and nothing simulates their noise"
        )
    if light.clipped >= MIN_CLIPPED:
        yield (
            f"{100 * light.clipped:.1f} % of the street's pixels are clipped at white in {light.images} images, most "
            f"in frame {light.worst_frame} ({100 * light.worst:.1f} %), as where the sun shines into the lens: there "
            "training only asks for at least as much light"
        )


def measured_light(frames: Frames, kept: Kept = NOTHING) -> Light:
    """Return the light of a spread of the images, which are those that ``kept`` is about."""
    return kept.get("light", (), lambda: _measured(frames), Light)


def _measured(frames: Frames) -> Light:
    places = spread(len(frames), MAX_FRAMES)
    rows = np.array([_of(frames[place]) for place in places])
    levels, noise, clipped = rows.T
    worst = int(clipped.argmax())
    return Light(
        float(np.median(levels)),
        float(np.median(noise)),
        float(clipped.mean()),
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


@dataclass(frozen=True)
class SkyShare:
    """Of all pixels of the images that were looked at."""

    share: float
    error: float
    """Standard error, by images."""
    frames: int


def sky_share(frames: Frames) -> SkyShare | None:
    """The share of sky in images spread over the drive; None where they have no masks."""
    masks = (frames[place].sky for place in spread(len(frames), MAX_FRAMES))
    shares = torch.tensor([float(mask.float().mean()) for mask in masks if mask is not None])
    if not len(shares):
        return None
    error = float(shares.std() / len(shares) ** 0.5) if len(shares) > 1 else 0.0
    return SkyShare(float(shares.mean()), error, len(shares))
