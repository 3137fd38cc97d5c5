"""Gray levels of the same static lidar points in different images: the gain of each image and channel."""

import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.geometry.boxes import box_at, inside_box
from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.types import Camera, Frame, Sweep, Track, View

MAX_IMAGES = 240
"""Images that are looked at: in five seconds at 240x144."""
RUN = 24
"""Neighboring instants that are looked at together, where not all are: images of neighbors show the same points."""
REACH = 8
"""Instants before and after an image whose sweeps give it points. Half as many would miss that most of a street stays
in sight for longer (docs/effects.md)."""
REACH_SECONDS = 0.8
"""The same in time, where the log has a clock: of a drive at 2 Hz the instants around are 20 m away, and what is seen
from there has another level without any gain."""
POINTS = 3000
"""Of each sweep."""
DARK, BRIGHT = 16, 245
"""Gray levels; a channel outside of them says little about a gain."""
BLOCKS = 80
"""Blocks of pixels over the width of an image: the nearest return in a block hides what lies behind."""
BEHIND, BEHIND_METERS = 1.05, 0.3
"""Factor, and meters more: what lies this far behind the nearest return is hidden."""
CONTRAST = 0.5
"""Largest difference of gray levels around a point, in parts of their mean: at an edge it matters where one looks."""
LOW = 0.8
"""Meters below a camera from which on a point belongs to the road, whose shine changes as one drives towards it."""
MIN_SHARED = 40
"""Points that two images share; fewer do not link them."""
OUTLIER = 0.3
"""Log ratio beside the median of its pair of images from which a point says nothing of shine."""
SHINE_STEP = 4
"""Of so many images one is asked about shine."""
MIN_SPREAD = 1.0
"""Squared log ratios of distances, summed over points, beside which shine is not measured: a tenth, of 100 points."""
JUMP, DRIFT = 0.07, 0.005
"""Log gains: a tenth of an EV, which cameras jump by, and what shine leaves of an error from instant to instant."""
FLOOR = 0.003
"""Standard error of a link that no number of points goes below: surfaces shine, and gray levels are rounded."""


@dataclass(frozen=True)
class Links:
    """Pairs of images that show the same points."""

    images: Int[Tensor, "l 2"]
    """Places of the first and the second image."""
    ratios: Float64[Tensor, "l 3"]
    """Median over the shared points of log(level in the second image / level in the first)."""
    errors: Float64[Tensor, "l 3"]
    """Standard errors of the medians, from the median absolute deviation."""
    shared: Int[Tensor, " l"]
    """Number of shared points."""


@dataclass(frozen=True)
class PartGains:
    """Gains of images, from some of the points that they share."""

    log_gains: Float64[Tensor, "n 3"]
    """Natural logarithms of the factors on stored levels, mean zero over the images; 0 for one without a link."""
    links: Links


@dataclass(frozen=True)
class ImageGains:
    """Gains of images, from all points that they share and from two kinds of them."""

    views: tuple[View, ...]
    """All that were looked at."""
    log_gains: Float64[Tensor, "n 3"]
    """From all points, as ``PartGains.log_gains``."""
    parts: tuple[PartGains, PartGains]
    """From points that lie low, on the road, and from the others. Gains change both; shine does not change both alike.
    """
    inner: Bool[Tensor, " n"]
    """Whether all instants around the image that the drive has were looked at, too."""
    mean_square: float
    """Of all levels, white is 1: an error e of a log gain changes a level by e times its root."""
    points: int
    """Different points that were seen."""


def image_gains(
    frames: Frames, sweeps: Sweeps, boxes: Sequence[Track], most: int | None = MAX_IMAGES
) -> ImageGains | None:
    """Gains of images that show the same static points.

    Every point that a sweep measured outside of the boxes is looked up in the images of the instants around, where
    nothing nearer hides it, no mask covers it, and its surroundings are even and neither dark nor white. The gains
    solve the log ratios of all linked pairs, each by its error, in iteratively reweighted least squares with Huber's
    weights. Slow drifts are the sum of many links and least certain: surfaces that change with the direction from which
    they are seen bias all links alike.

    Args:
        frames: images, with their masks.
        sweeps: lidar of these instants.
        boxes: objects that may move or shine; what lies in them is left out.
        most: images that are looked at, in runs of ``RUN`` neighboring instants; None: all.

    Returns None where no two images share ``MIN_SHARED`` points, as without lidar.
    """
    instants = _instants(frames.views, most)
    rank = {index: place for place, index in enumerate(instants)}
    looked_at = {sweep.index: sweep for sweep in sweeps.where(rank.__contains__).gray()}
    points, ranks = _static_points(looked_at, rank, boxes)
    reach = _reach(frames.views)
    levels = _Levels(len(points), reach)
    for frame in frames.where(lambda view: view.frame_index in rank):
        index, _ = frame.indices
        near = ((ranks - rank[index]).abs() <= reach).nonzero().flatten()
        others = looked_at[index].points if index in looked_at else points[:0]
        levels.look_up(frame, rank[index], points[near], near, others)
    everything, *parts = levels.links()
    if not len(everything.shared):
        return None
    low, high = (PartGains(solved(links, len(levels.views)), links) for links in parts)
    inner = _inner(levels.views, {view.indices[0] for view in frames.views}, set(instants), reach)
    gains = solved(everything, len(levels.views))
    return ImageGains(tuple(levels.views), gains, (low, high), inner, levels.mean_square, levels.seen)


def solved(links: Links, images: int) -> Float64[Tensor, "n 3"]:
    """The log gains whose differences are nearest to the ratios of the links, mean zero over the images."""
    first, second = links.images.unbind(1)
    gains = torch.zeros(images, 3, dtype=torch.float64)
    if not len(first):
        return gains
    for channel in range(3):
        ratios = links.ratios[:, channel]
        precise = 1 / (links.errors[:, channel].square() + FLOOR**2)
        weights = precise
        for _ in range(6):
            gains[:, channel] = _least_squares(first, second, ratios, weights, images)
            misfit = (ratios - (gains[second, channel] - gains[first, channel])).abs() * precise.sqrt()
            # A misfit of no more than its own standard error is no outlier.
            scale = (1.345 * 1.4826 * misfit.median()).clamp(min=1)
            weights = precise * (scale / misfit.clamp(min=scale))
    return gains - gains.mean(0)


def without_drift(gains: ImageGains) -> Float64[Tensor, "n 3"]:
    """Return the log gains less the slow part that the images of all cameras share.

    A drift is the sum of many links, and so is what is left of shine: nothing tells the two apart. Of the mean m over
    the cameras at each instant, drift is the d with the least::

        sum_t (m_t - d_t)^2 / JUMP^2 + (d_t+1 - d_t)^2 / DRIFT^2
    """
    instants = torch.tensor([view.indices[0] for view in gains.views]).unique(return_inverse=True)[1]
    count = int(instants.max()) + 1
    images = torch.bincount(instants, minlength=count).double()[:, None]
    mean = torch.zeros(count, 3, dtype=torch.float64).index_add(0, instants, gains.log_gains) / images
    steps = torch.eye(count, dtype=torch.float64).diff(dim=0)
    system = torch.eye(count, dtype=torch.float64) + (JUMP / DRIFT) ** 2 * steps.T @ steps
    drift = torch.linalg.solve(system, mean)
    found = gains.log_gains - drift[instants]
    return found - found.mean(0)


def _least_squares(first: Tensor, second: Tensor, ratios: Tensor, weights: Tensor, images: int) -> Tensor:
    normal = torch.zeros(images, images, dtype=torch.float64)
    for a, b, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
        normal.index_put_((a, b), sign * weights, accumulate=True)
    right = torch.zeros(images, dtype=torch.float64)
    right = right.index_add(0, second, weights * ratios).index_add(0, first, -weights * ratios)
    # Only differences are determined, in each group of linked images: of all solutions the smallest.
    ridge = 1e-9 * normal.diagonal().mean()
    return torch.linalg.solve(normal + ridge * torch.eye(images, dtype=torch.float64), right)


def _instants(views: Sequence[View], most: int | None) -> list[int]:
    """Integer frames to look at: all, or runs of neighbors that are spread over the drive."""
    instants = sorted({view.indices[0] for view in views})
    cameras = len({view.camera_index for view in views})
    if most is None or len(views) <= most:
        return instants
    runs = max(most // (RUN * cameras), 1)
    last = max(len(instants) - RUN, 0)
    starts = [round(last * (run + 0.5) / runs) if runs == 1 else round(last * run / (runs - 1)) for run in range(runs)]
    return sorted({index for start in starts for index in instants[start : start + RUN]})


def _reach(views: Sequence[View]) -> int:
    """Instants before and after an image that count, two at least: by a clock those within ``REACH_SECONDS``."""
    moments = {view.indices[0]: view.seconds for view in views}
    seconds = sorted(moment for moment in moments.values() if moment is not None)
    steps = [behind - before for before, behind in pairwise(seconds) if behind > before]
    if not steps:
        return REACH
    return min(max(round(REACH_SECONDS / statistics.median(steps)), 2), REACH)


def _inner(views: Sequence[View], recorded: set[int], looked_at: set[int], reach: int) -> Bool[Tensor, " n"]:
    missing = recorded - looked_at
    return torch.tensor([not any(abs(view.indices[0] - index) <= reach for index in missing) for view in views])


def _static_points(
    sweeps: dict[int, Sweep], rank: dict[int, int], boxes: Sequence[Track]
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """Points that a camera sees and that lie in no box, and the rank of the instant that measured each."""
    points, ranks = [torch.zeros(0, 3)], [torch.zeros(0, dtype=torch.int64)]
    for index, sweep in sweeps.items():
        rows = (sweep.colored & _outside(boxes, sweep)).nonzero().flatten()
        rows = rows[:: len(rows) // POINTS + 1]
        points.append(sweep.points[rows])
        ranks.append(torch.full((len(rows),), rank[index]))
    return torch.cat(points), torch.cat(ranks)


def _outside(boxes: Sequence[Track], sweep: Sweep) -> Bool[Tensor, " n"]:
    """Whether points of a sweep lie in no box; boxes are imprecise, so each counts as 10 % larger."""
    outside = torch.ones(len(sweep.points), dtype=torch.bool)
    for track in boxes:
        world_from_box = box_at(track, sweep.index, sweep.time)
        if world_from_box is not None:
            in_box = transform_points(inverse(world_from_box).to(sweep.points), sweep.points)
            outside &= ~inside_box(in_box, track.size, 1.1)
    return outside


class _Levels:
    """Log levels of numbered points in one image after the other."""

    def __init__(self, points: int, reach: int) -> None:
        self._reach = reach
        self.views: list[View] = []
        self._ranks: list[int] = []
        self._numbers: list[Int[Tensor, " _"]] = []
        self._logs: list[Float[Tensor, "_ 3"]] = []
        self._low: list[Bool[Tensor, " _"]] = []
        self._distances: list[Float[Tensor, " _"]] = []
        self._squares = 0.0
        self._points = points

    @property
    def mean_square(self) -> float:
        return self._squares / max(len(self.views), 1)

    @property
    def seen(self) -> int:
        return len(torch.cat(self._numbers).unique())

    def look_up(self, frame: Frame, rank: int, points: Tensor, numbers: Tensor, others: Tensor) -> None:
        """Look points up in an image; ``others`` may hide them, and are not looked up."""
        pixels, depths, inside = project(frame.camera, torch.cat((points, others)))
        inside &= _unhidden(frame.camera, pixels, depths, inside)
        rows = inside[: len(points)].nonzero().flatten()
        level, usable, side = _even_levels(frame)
        column = (pixels[rows, 0] / side).long().clamp(max=level.shape[1] - 1)
        line = (pixels[rows, 1] / side).long().clamp(max=level.shape[0] - 1)
        kept = usable[line, column]
        self.views.append(View(**{entry.name: getattr(frame, entry.name) for entry in fields(View)}))
        self._ranks.append(rank)
        self._numbers.append(numbers[rows[kept]])
        self._logs.append(level[line[kept], column[kept]].log())
        places = transform_points(frame.camera.camera_from_world.to(points), points[rows[kept]])
        self._low.append(places[:, 1] > LOW)
        self._distances.append(places.norm(dim=1).log())
        self._squares += float((frame.image.float() / 255).square().mean())

    def links(self) -> tuple[Links, Links, Links]:
        """All pairs of images that share enough points; those by low points alone, and by the others alone."""
        found = _Pairs(), _Pairs(), _Pairs()
        shines = self._shines()
        for first, second, ratio, nearing, low in self._shared(range(len(self.views))):
            shine = torch.where(low[:, None] == 1, shines[1], shines[0])
            ratio = ratio - nearing[:, None] * shine
            for pairs, of in zip(found, (slice(None), low == 1, low == 0), strict=True):
                pairs.add(first, second, ratio[of])
        everything, below, above = (pairs.links() for pairs in found)
        return everything, below, above

    def _shines(self) -> Float[Tensor, "2 3"]:
        """By how much levels of other and of low points change with the logarithm of their distance.

        A gain changes all points of an image alike. A road in front of a low sun gets darker as one comes nearer, the
        near part of it more than the far one: what points of one pair of images show of it beside each other is no
        gain, and neither is what all of them have of it.
        """
        products, squares = torch.zeros(2, 3), torch.full((2, 1), MIN_SPREAD)
        for _, _, ratio, nearing, low in self._shared(range(0, len(self.views), SHINE_STEP)):
            for kind in (0, 1):
                own = low == kind
                if int(own.sum()) >= MIN_SHARED:
                    change = ratio[own] - ratio[own].median(0).values
                    apart = (nearing[own] - nearing[own].median())[:, None]
                    products[kind] += torch.where(change.abs() < OUTLIER, apart * change, 0.0).sum(0)
                    squares[kind] += apart.square().sum()
        return products / squares

    def _shared(
        self, images: range
    ) -> Iterator[tuple[int, int, Float[Tensor, "p 3"], Float[Tensor, " p"], Int[Tensor, " p"]]]:
        """Yield what some images share with all that come after them: log ratios of levels and distances of points, and
        their kind.

        Kinds: 0 other, 1 low, 2 low in one of the images alone.
        """
        place = torch.empty(self._points, dtype=torch.int64)
        for first in images:
            numbers = self._numbers[first]
            place.fill_(-1)
            place[numbers] = torch.arange(len(numbers))
            for second in range(first + 1, len(self.views)):
                if abs(self._ranks[second] - self._ranks[first]) > 2 * self._reach:
                    continue
                at = place[self._numbers[second]]
                both = at >= 0
                if int(both.sum()) < MIN_SHARED:
                    continue
                at = at[both]
                ratio = self._logs[second][both] - self._logs[first][at]
                nearing = self._distances[second][both] - self._distances[first][at]
                low, before = self._low[second][both], self._low[first][at]
                yield first, second, ratio, nearing, torch.where(low == before, low.long(), 2)


class _Pairs:
    """Links as they are found."""

    def __init__(self) -> None:
        self._images: list[tuple[int, int]] = []
        self._ratios = [torch.zeros(3)]
        self._errors = [torch.zeros(3)]
        self._shared: list[int] = []

    def add(self, first: int, second: int, ratio: Float[Tensor, "p 3"]) -> None:
        """Log ratios at shared points; too few are no link."""
        if len(ratio) < MIN_SHARED:
            return
        middle = ratio.median(0).values
        self._images.append((first, second))
        self._ratios.append(middle)
        # Of a normal distribution 1.4826 of the median absolute deviation is the standard deviation, and the error of
        # the median is 1.2533 of the mean's.
        self._errors.append(1.86 * (ratio - middle).abs().median(0).values / len(ratio) ** 0.5)
        self._shared.append(len(ratio))

    def links(self) -> Links:
        images = torch.tensor(self._images, dtype=torch.int64).reshape(-1, 2)
        ratios, errors = (torch.stack(values)[1:].double() for values in (self._ratios, self._errors))
        return Links(images, ratios, errors, torch.tensor(self._shared, dtype=torch.int64))


def _unhidden(
    camera: Camera, pixels: Float[Tensor, "n 2"], depths: Float[Tensor, " n"], inside: Bool[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Whether a point lies hardly behind the nearest one of its block of pixels."""
    side = camera.width / BLOCKS
    columns, lines = BLOCKS + 1, int(camera.height / side) + 1
    column, line = (pixels / side).nan_to_num().clamp(-1, 1e6).long().unbind(-1)
    block = torch.where(inside, line * columns + column, 0)
    nearest = torch.full((columns * lines,), torch.inf).scatter_reduce(0, block[inside], depths[inside], "amin")
    return depths <= BEHIND * nearest[block] + BEHIND_METERS


def _even_levels(frame: Frame) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"], int]:
    """Mean level around each place, and whether all levels there are alike, not masked, not dark and not white.

    Places are squares of pixels, of the side that is returned third; the surroundings are 3x3 of them.
    """
    side = max(round(frame.camera.width / (3 * BLOCKS)), 1)

    def largest(image: Tensor) -> Tensor:
        # In two steps: the cost of one grows with the square of its window.
        return max_pool2d(max_pool2d(image, side), 3, stride=1, padding=1)

    image = frame.image.float().permute(2, 0, 1)
    mean = avg_pool2d(avg_pool2d(image, side), 3, stride=1, padding=1, count_include_pad=False)
    low, high = -largest(-image), largest(image)
    usable = ((low >= DARK) & (high <= BRIGHT) & (high - low <= CONTRAST * mean)).all(0)
    for mask in (frame.ego, frame.human, frame.vehicle, frame.sky):
        if mask is not None:
            usable &= largest(mask.float()[None])[0] == 0
    return mean.permute(1, 2, 0), usable, side


EV = 0.6931471805599453
"""ln 2: a gain of one EV doubles."""
ERROR_BLOCKS = 8
"""Parts of the drive, of which each is left out once for the standard error."""
MIN_INSTANTS = 8
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
    """Standard error of ``removed``, by leaving out one of ``ERROR_BLOCKS`` parts of the drive at a time; None: one
    part."""
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

    Returns None where they are of fewer than ``MIN_INSTANTS``.
    """
    (low, foretold_low), (high, foretold_high) = (_errors(gains, part) for part in gains.parts)
    places = torch.tensor(sorted(foretold_low.keys() & foretold_high.keys()), dtype=torch.int64)
    if len({gains.views[place].frame_index for place in places.tolist()}) < MIN_INSTANTS:
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
    blocks = (
        ((times - times.min()) / (times.max() - times.min()).clamp(min=1e-9) * ERROR_BLOCKS)
        .long()
        .clamp(max=ERROR_BLOCKS - 1)
    )
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
