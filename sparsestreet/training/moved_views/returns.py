"""The returns of the training sweeps: those of the street, and those of moving objects in the frames of their boxes."""

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from sparsestreet.data.images import WHITE
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.lidar import visible_pixels
from sparsestreet.geometry.boxes import CarriedPoints, box_at, crossings, inside_box
from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.kept import Kept
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.gaussians import at_most, outside_boxes, returns_in_box_frame
from sparsestreet.types import Camera, Frame, Sweep, Track, View


@dataclass(frozen=True, kw_only=True)
class MovedViews:
    """Settings of the terms of moved views. Raises ValueError for impossible ones.

    Both terms are sums over the pixels whose content is known, divided by all pixels of the view: the less the lidar
    sees, the less they weigh.
    """

    every: int = 4
    """Steps from one moved view to the next."""
    start: float = 0.1
    stop: float = 0.9
    """Fractions of the run between which views are moved. The rest before the end belongs to the recorded views."""
    sideways: float = 4.0
    """Meters; a camera moves by a uniformly drawn distance up to this to the left or right, but into no wall."""
    divisor: int = 2
    """Sides of a moved view are those of the recorded one divided by this."""
    depth_weight: float = 4.0
    """Of the absolute error of the inverse depth, 1/m."""
    color_weight: float = 4.0
    """Of the absolute error of the color, mean over its channels."""
    sweeps: int = 10
    """How many frames before and after its own a view sees returns of."""
    returns_per_sweep: int = 30_000
    """A sweep keeps at most this number of returns, drawn at random: memory."""
    returns_per_view: int = 30_000
    """A view looks at no more returns, drawn at random in each step: time."""
    tolerance: float = 0.1
    """Difference between the color of a return and an image of another instant at which the return weighs 1/e."""

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("every", "divisor", "returns_per_sweep", "returns_per_view")}
        if wrong := {name: value for name, value in counts.items() if value < 1}:
            raise ValueError(f"moved views count from 1, got {wrong}: moved_views=none leaves them out")
        positive = {name: getattr(self, name) for name in ("sideways", "tolerance")}
        if wrong := {name: value for name, value in positive.items() if not value > 0}:
            raise ValueError(
                f"moved views need lengths and tolerances above 0, got {wrong}: moved_views=none leaves them out"
            )
        least = {name: getattr(self, name) for name in ("depth_weight", "color_weight", "sweeps")}
        if wrong := {name: value for name, value in least.items() if not value >= 0}:
            raise ValueError(f"moved views need weights and numbers of sweeps of at least 0, got {wrong}")
        if not 0 <= self.start <= self.stop <= 1:
            raise ValueError(f"moved views need 0 <= start <= stop <= 1, got {self.start} and {self.stop}")


NEAREST, FARTHEST = 0.5, 80.0
"""Meters; returns outside count nothing, as in the depth term."""
WINDOW = 5
"""Pixels. A return is hidden if a clearly nearer one lies in the window around it: one sees through sparse points."""
SLACK, SLACK_METERS = 1.15, 0.3
"""Clearly nearer: by more than this factor and distance. A road seen at a flat angle stays within."""
ENLARGEMENT = 1.1
"""Of the boxes behind which nothing is known: they are imprecise."""
_NO_RETURN = torch.iinfo(torch.int64).max


Gain = Callable[[View], Float[Tensor, "3"]]
"""Factors by which red, green and blue of an image are brighter than those of others."""


@dataclass(frozen=True)
class Colors:
    """What images of several gains show of points."""

    values: Float[Tensor, "*n 3"]
    """RGB without the gain of the image; 1 is white at a gain of 1."""
    cut_off: Bool[Tensor, "*n 3"]
    """Whether a channel was recorded at white: then its value is a lower bound."""

    @staticmethod
    def of(pixels: UInt8[Tensor, "n 3"], gain: Float[Tensor, "3"]) -> "Colors":
        """Make those of pixels of an image with a gain."""
        return Colors(pixels.float() / 255 / gain.cpu(), pixels >= WHITE)

    def to(self, device: torch.device) -> "Colors":
        return Colors(self.values.to(device, non_blocking=True), self.cut_off.to(device, non_blocking=True))

    def at(self, rows: Int[Tensor, "..."]) -> "Colors":
        """Return those of some rows, in the shape of these."""
        return Colors(self.values[rows], self.cut_off[rows])

    def missing(self, others: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Return how much brighter these are than the others; above a lower bound nothing is missing."""
        more = self.values - others
        return torch.where(self.cut_off, more.clamp(min=0), more)

    def distance(self, others: "Colors") -> Float[Tensor, " n"]:
        """Return the mean difference of channels; neither misses anything above its lower bound."""
        more = self.missing(others.values)
        return torch.where(others.cut_off, more.clamp(max=0), more).abs().mean(-1)


@dataclass(frozen=True)
class Returns:
    """Colored lidar returns."""

    points: Float[Tensor, "n 3"]
    """World, or the frame of a box, meters."""
    colors: Colors
    weights: Float[Tensor, " n"]
    """How far they are trusted, in [0, 1]."""

    def __len__(self) -> int:
        return self.points.shape[0]

    def at(self, rows: Int[Tensor, " k"]) -> "Returns":
        return Returns(self.points[rows], self.colors.at(rows), self.weights[rows])

    @staticmethod
    def concatenate(parts: "Sequence[Returns]") -> "Returns":
        """The rows of all parts in order."""
        if not parts:
            nothing = torch.zeros(0, 3)
            return Returns(nothing, Colors(nothing, nothing.bool()), torch.zeros(0))
        return Returns(
            torch.cat([part.points for part in parts]),
            Colors(
                torch.cat([part.colors.values for part in parts]), torch.cat([part.colors.cut_off for part in parts])
            ),
            torch.cat([part.weights for part in parts]),
        )


@dataclass(frozen=True)
class Target:
    """What is known of an image. Where the weight is 0, the other numbers mean nothing."""

    depth: Float[Tensor, "h w"]
    """Along the optical axis, meters."""
    colors: Colors
    """One a pixel."""
    weight: Float[Tensor, "h w"]


Box = tuple[Float64[Tensor, "4 4"], Float[Tensor, "3"]]
"""world_from_box, and the lengths of its sides in meters."""


def target(camera: Camera, street: Returns, objects: Returns, boxes: Sequence[Box], reach: float = 0.5) -> Target:
    """Each pixel takes the nearest of the returns that fall into its middle and that nothing hides.

    Args:
        camera: that looks.
        street: what stands still; where one of the boxes is in the way nothing is known of it.
        objects: what lies in some of the boxes.
        boxes: of all moving objects at this instant.
        reach: pixels from a pixel's center, along both axes, within which a return counts. 0.5 is the whole pixel; a
            smaller part compares a point with what is rendered at that very point.
    """
    returns = Returns.concatenate([street, objects])
    if not len(returns):
        shape = (camera.height, camera.width)
        nothing = torch.zeros(*shape, 3)
        return Target(torch.ones(shape), Colors(nothing, nothing.bool()), torch.zeros(shape))
    rows, positions, depths = unhidden(camera, returns.points)
    counts = ((positions % 1 - 0.5).abs() <= reach).all(1) & (depths > NEAREST) & (depths < FARTHEST)
    rows, positions, depths = rows[counts], positions[counts], depths[counts]
    counts = (rows >= len(street)) | ~behind_boxes(camera, returns.points[rows], boxes)
    rows, positions, depths = rows[counts], positions[counts], depths[counts]
    # Bits of positive floats are in their order; of equally near returns the first counts, on every device.
    keys = (depths.view(torch.int32).long() << 32) | rows
    size = camera.height * camera.width
    first = torch.full((size,), _NO_RETURN, device=keys.device).scatter_reduce(
        0, _pixels(camera, positions), keys, "amin"
    )
    found = (first != _NO_RETURN).view(camera.height, camera.width)
    row = torch.where(found.flatten(), first & 0xFFFFFFFF, 0)
    return Target(
        torch.where(found, (first >> 32).to(torch.int32).view(torch.float32).view(found.shape), 1.0),
        returns.colors.at(row.view(found.shape)),
        torch.where(found, returns.weights[row].view(found.shape), 0.0),
    )


def unhidden(
    camera: Camera, points: Float[Tensor, "n 3"], window: int = WINDOW
) -> tuple[Int[Tensor, " v"], Float[Tensor, "v 2"], Float[Tensor, " v"]]:
    """Rows, image positions (pixels) and depths (meters) of the points in the image that none of the others hides."""
    positions, depths, inside = project(camera, points)
    rows = torch.nonzero(inside).squeeze(-1)
    positions, depths = positions[rows], depths[rows]
    pixels = _pixels(camera, positions)
    nearest = torch.full((camera.height * camera.width,), 1e6, device=points.device)
    image = nearest.scatter_reduce(0, pixels, depths, "amin").view(1, camera.height, camera.width)
    around = -max_pool2d(-image, window, stride=1, padding=window // 2).flatten()[pixels]
    seen = depths <= SLACK * around + SLACK_METERS
    return rows[seen], positions[seen], depths[seen]


def behind_boxes(camera: Camera, points: Float[Tensor, "n 3"], boxes: Sequence[Box]) -> Bool[Tensor, " n"]:
    """Whether the line from the camera to a point meets one of the boxes.

    >>> camera = Camera(torch.eye(4), torch.eye(3), width=4, height=4)
    >>> box = torch.eye(4, dtype=torch.float64)
    >>> box[2, 3] = 5.0
    >>> points = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 9.0], [9.0, 0.0, 9.0]])
    >>> behind_boxes(camera, points, [(box, torch.tensor([2.0, 2.0, 2.0]))]).tolist()
    [False, True, False]
    """
    hidden = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for world_from_box, size in boxes:
        box_from_world = inverse(world_from_box).to(points)
        eye = transform_points(box_from_world, camera.position[None].to(points))
        steps = transform_points(box_from_world, points) - eye
        enters, leaves = crossings(eye, steps, ENLARGEMENT * size.to(points))
        hidden |= (enters < leaves) & (leaves > 0) & (enters < 1)
    return hidden


def _pixels(camera: Camera, positions: Float[Tensor, "n 2"]) -> Int[Tensor, " n"]:
    column, line = positions.long().unbind(-1)
    return line * camera.width + column


def seen_colors(
    points: Float[Tensor, "n 3"], frames: Sequence[Frame], places: Sequence[Float[Tensor, "n 3"]], gain: Gain
) -> tuple[Colors, Bool[Tensor, " n"]]:
    """Color of each point in the first image that shows it, and which points one shows.

    ``places``: where the points are in each of the images. Unlike ``data.lidar.color_points`` a point behind nearer
    ones has no color: the lidar stands higher than the cameras and looks over cars, whose color such a point would
    take.
    """
    colors = Colors(torch.zeros_like(points), torch.zeros_like(points, dtype=torch.bool))
    seen = torch.zeros(len(points), dtype=torch.bool)
    for frame, place in zip(frames, places, strict=True):
        rows, positions, _ = unhidden(frame.camera, place)
        column, line = positions.long().unbind(-1)
        if frame.ego is not None:  # the recording car hides what lies behind it
            shown = ~frame.ego[line, column]
            rows, column, line = rows[shown], column[shown], line[shown]
        new = ~seen[rows]
        shown = Colors.of(frame.image[line[new], column[new]], gain(frame))
        colors.values[rows[new]], colors.cut_off[rows[new]] = shown.values, shown.cut_off
        seen[rows] = True
    return colors, seen


def agreement(
    points: Float[Tensor, "n 3"], colors: Colors, others: Sequence[Frame], tolerance: float, gain: Gain
) -> Float[Tensor, " n"]:
    """exp(-d / tolerance), d the least difference to images of other instants; 1 where none shows the point.

    A point that stands still has its color in some other image too. One on an object that moves without a box, at an
    edge that lidar and camera see at different places, or on a mirror has not.
    """
    least = torch.full((len(points),), torch.inf)
    for frame in others:
        rows, pixels, _ = visible_pixels(frame.camera, points, frame.ego)
        there = Colors.of(frame.image.reshape(-1, 3)[pixels], gain(frame))
        least[rows] = torch.minimum(least[rows], colors.at(rows).distance(there))
    return torch.where(least.isinf(), 1.0, torch.exp(-least / tolerance))


POINT_ENLARGEMENT = 1.15
"""Of moving boxes, in which nothing belongs to the street."""
ROAD = 0.25
"""Meters above the floor of its box from which on a return belongs to the object and not to the road below it."""


@dataclass(frozen=True)
class StreetReturns:
    """What lidar says of the street at all training instants, and of its objects at each."""

    street: Returns
    """World, in the order of the sweeps."""
    frames: tuple[int, ...]
    """Integer frames of the sweeps."""
    starts: tuple[int, ...]
    """First row of each sweep in ``street``, and behind the last one the number of rows."""
    objects: Mapping[int, Returns]
    """Integer frame -> returns of this frame from objects of fixed shape, in the world, at the time of the sweep."""
    moving: tuple[Track, ...]
    """All objects that move."""
    carried: Mapping[int, CarriedPoints] = field(default_factory=dict)
    """Integer frame -> the points of ``objects``, which these carry to other times of the frame."""

    def around(self, frame: int, sweeps: int) -> slice:
        """Rows of the street from at most ``sweeps`` frames before or after."""
        first, behind = bisect_left(self.frames, frame - sweeps), bisect_right(self.frames, frame + sweeps)
        return slice(self.starts[first], self.starts[behind])

    def objects_at(self, frame: int, time: float) -> Returns:
        """From objects of fixed shape, in the world at a time of the frame."""
        found = self.objects.get(frame, Returns.concatenate([]))
        return replace(found, points=self.carried[frame].at(time)) if frame in self.carried else found

    def boxes(self, frame: int, time: float) -> list[Box]:
        """Of the moving objects at a time of a frame."""
        found = [(box_at(track, frame, time), track.size) for track in self.moving]
        return [(pose, size) for pose, size in found if pose is not None]

    def agreement(self) -> float:
        """Mean weight of the street's returns, in [0, 1]."""
        return float(self.street.weights.mean()) if len(self.street) else 1.0


def collect(
    sweeps: Sweeps,
    frames: Frames,
    moving: Sequence[Track],
    rigid: Sequence[Track],
    settings: MovedViews,
    seed: int,
    gain: Gain,
) -> StreetReturns:
    """The returns of sweeps, in the colors of the images of their instants.

    Args:
        sweeps: of the training instants.
        frames: training views; their images color the returns.
        moving: objects that move; nothing in their boxes belongs to the street.
        rigid: those of them that keep their shape.
        settings: how many returns are kept, and how their weights fall.
        seed: of the choice of the returns that are kept.
        gain: of each of the ``frames``.
    """
    places = _by_instant(frames)
    instants = sorted(places)

    # Sweeps come in order: each image is decoded once, and few are in memory.
    @lru_cache(maxsize=3)
    def images(instant: int) -> list[Frame]:
        return [frames[place] for place in places.get(instant, [])]

    generator = named_generator(seed, "moved views")
    street, starts, objects, carried = [], [0], {}, {}
    for sweep in sweeps:
        points = CarriedPoints(sweep.points, sweep.time, sweep.index, moving, POINT_ENLARGEMENT)
        shown = images(sweep.index)
        colors, seen = seen_colors(sweep.points, shown, [points.at(frame.time) for frame in shown], gain)
        still = seen & outside_boxes(moving, sweep, POINT_ENLARGEMENT)
        rows = at_most(settings.returns_per_sweep, torch.nonzero(still).squeeze(-1), generator)
        others = [frame for near in _beside(sweep.index, instants) for frame in images(near)]
        weights = agreement(sweep.points[rows], colors.at(rows), others, settings.tolerance, gain)
        street.append(Returns(sweep.points[rows], colors.at(rows), weights))
        starts.append(starts[-1] + len(rows))
        on = torch.nonzero(seen & _on_objects(sweep, rigid)).squeeze(-1)
        carried[sweep.index] = replace(points, points=sweep.points[on], tracks=rigid)
        objects[sweep.index] = Returns(carried[sweep.index].points, colors.at(on), torch.ones(len(on)))
    return StreetReturns(Returns.concatenate(street), sweeps.indices, tuple(starts), objects, tuple(moving), carried)


def kept_returns(
    kept: Kept,
    make: Callable[[], StreetReturns],
    moving: Sequence[Track],
    rigid: Sequence[Track],
    *said: object,
) -> StreetReturns:
    """Return what ``make`` collects of these objects; from an earlier run on the same log, if one kept it.

    ``said``: what the answer depends on beside the log and the objects.
    """

    def collected() -> StreetReturns:
        found = make()
        return replace(found, moving=(), carried=_by(found.carried, ()))

    said = moving, rigid, *said
    found = kept.get("returns", said, collected, StreetReturns, Returns, Colors, CarriedPoints)
    return replace(found, moving=tuple(moving), carried=_by(found.carried, rigid))


def _by(carried: Mapping[int, CarriedPoints], tracks: Sequence[Track]) -> dict[int, CarriedPoints]:
    """The points, carried by these objects."""
    return {frame: replace(points, tracks=tracks) for frame, points in carried.items()}


def _by_instant(frames: Frames) -> dict[int, list[int]]:
    """Integer frame -> places of its views; no pixel is read."""
    found = defaultdict(list)
    for place, view in enumerate(frames.views):
        found[view.indices[0]].append(place)
    return found


def _beside(frame: int, instants: Sequence[int]) -> list[int]:
    """The instants before and after a frame."""
    return [*instants[: bisect_left(instants, frame)][-1:], *instants[bisect_right(instants, frame) :][:1]]


def _on_objects(sweep: Sweep, rigid: Sequence[Track]) -> Tensor:
    on = torch.zeros(len(sweep.points), dtype=torch.bool)
    for track in rigid:
        local = returns_in_box_frame(track, sweep)
        if local is not None:
            on |= inside_box(local, track.size) & (local[:, 2] > ROAD - track.size[2] / 2)
    return on
