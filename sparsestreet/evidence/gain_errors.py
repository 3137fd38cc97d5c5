"""What held-out images lose to the gains of images, with a gain for each image and without."""

from collections import defaultdict
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.evidence.exposure import ImageGains, Links, PartGains

EV = 0.6931471805599453
"""ln 2: a gain of one EV doubles."""
BLOCKS = 8
"""Parts of the drive, of which each is left out once for the standard error."""
FEWEST_INSTANTS = 8
"""What images of fewer instants have in common may be the street as well as a gain."""


@dataclass(frozen=True)
class GainErrors:
    """Root mean square errors of gains over images and channels, EV, as if each image were held out.

    A square is the product of what low points and the others say. So it holds what both agree on: neither the noise of
    medians nor the shine of a road adds to it. It is 0 where they disagree.
    """

    without: float
    """Against the mean gain of the images that show the same points: what one street for all images misses."""
    foretold: float
    """Against the gain on the line between the neighbors in time of the same camera."""
    removed: float
    """Root of the difference of the squares, 0 where neighbors foretell nothing: what a gain for each image removes."""
    noise: float | None
    """Standard error of ``removed``, by leaving out one of ``BLOCKS`` parts of the drive at a time; None: one part."""
    color: float
    """The part of ``without`` in which channels differ from each other."""
    agreement: float
    """Correlation between the errors that low points show and those that the others show; 1: gains explain both."""
    cameras: dict[int, tuple[float, float, float]]
    """By camera index: mean over its images of the log gain of red, green and blue, EV."""
    images: int
    low: Float64[Tensor, " i"]
    """Of each of these images, what low points say of ``without``: the mean over channels, EV."""
    high: Float64[Tensor, " i"]
    """The same of the others."""


def gain_errors(gains: ImageGains) -> GainErrors | None:
    """Errors of all inner images with a neighbor on both sides that both kinds of points link.

    Returns None where they are of fewer than ``FEWEST_INSTANTS``.
    """
    (low, foretold_low), (high, foretold_high) = (_errors(gains, part) for part in gains.parts)
    places = torch.tensor(sorted(foretold_low.keys() & foretold_high.keys()), dtype=torch.int64)
    if len({gains.views[place].frame_index for place in places.tolist()}) < FEWEST_INSTANTS:
        return None
    low, high = low[places], high[places]
    without = (low * high).mean(1)
    foretold = torch.stack([(foretold_low[place] * foretold_high[place]).mean() for place in places.tolist()])
    apart = (low - low.mean(1, keepdim=True)) * (high - high.mean(1, keepdim=True))
    sizes = (low.square().mean() * high.square().mean()).sqrt()
    return GainErrors(
        without=_root(without.mean()),
        foretold=_root(foretold.mean()),
        removed=_removed(without, foretold),
        noise=_jackknife(without, foretold, torch.tensor([gains.views[place].time for place in places.tolist()])),
        color=_root(apart.mean()),
        agreement=float(without.mean() / sizes.clamp(min=1e-12)),
        cameras=_by_camera(gains),
        images=len(places),
        low=low.mean(1),
        high=high.mean(1),
    )


def _errors(gains: ImageGains, part: PartGains) -> tuple[Float64[Tensor, "n 3"], dict[int, Float64[Tensor, "3"]]]:
    """Of all images, the gain less the mean of others that show the same points; by place, that less the neighbors'."""
    log_gains = part.log_gains / EV
    return log_gains - _around(part.links, log_gains), _foretold(gains, part, log_gains)


def _around(links: Links, log_gains: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3"]:
    """For each image the mean gain of the others that show its points, by the number of these."""
    first, second = links.images.unbind(1)
    weights = torch.zeros(len(log_gains), len(log_gains), dtype=torch.float64)
    weights[first, second] = weights[second, first] = links.shared.double()
    total = weights.sum(1, keepdim=True)
    return torch.where(total > 0, weights @ log_gains / total.clamp(min=1), log_gains)


def _foretold(gains: ImageGains, part: PartGains, log_gains: Float64[Tensor, "n 3"]) -> dict[int, Float64[Tensor, "3"]]:
    """By place of an image between two others of its camera: how far its gain is off the line between these."""
    linked = set(part.links.images.flatten().tolist())
    by_camera: dict[int, list[int]] = defaultdict(list)
    for place, view in sorted(enumerate(gains.views), key=lambda entry: entry[1].time):
        if place in linked:
            by_camera[view.indices[1]].append(place)
    errors = {}
    for own in by_camera.values():
        for before, place, behind in zip(own, own[1:], own[2:], strict=False):
            if gains.inner[place]:
                a, here, b = (gains.views[one].time for one in (before, place, behind))
                line = torch.lerp(log_gains[before], log_gains[behind], (here - a) / (b - a))
                errors[place] = log_gains[place] - line
    return errors


def _root(square: Tensor) -> float:
    return float(square.clamp(min=0).sqrt())


def _removed(without: Tensor, foretold: Tensor) -> float:
    return _root(without.mean() - foretold.mean().clamp(min=0))


def _jackknife(without: Tensor, foretold: Tensor, times: Tensor) -> float | None:
    blocks = ((times - times.min()) / (times.max() - times.min()).clamp(min=1e-9) * BLOCKS).long().clamp(max=BLOCKS - 1)
    used = blocks.unique()
    if len(used) < 2:
        return None
    values = torch.tensor([_removed(without[blocks != one], foretold[blocks != one]) for one in used.tolist()])
    return float(((len(used) - 1) * (values - values.mean()).square().mean()).sqrt())


def _by_camera(gains: ImageGains) -> dict[int, tuple[float, float, float]]:
    log_gains = gains.log_gains / EV
    cameras = torch.tensor([view.indices[1] for view in gains.views])
    found = {}
    for camera in cameras.unique().tolist():
        red, green, blue = log_gains[cameras == camera].mean(0).tolist()
        found[camera] = red, green, blue
    return found
