"""What returns say of the pixels of a camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.types import Camera

NEAREST, FARTHEST = 0.5, 80.0
"""Meters; returns outside count nothing, as in the depth term."""
WINDOW = 5
"""Pixels. A return is hidden if a clearly nearer one lies in the window around it: one sees through sparse points."""
SLACK, SLACK_METERS = 1.15, 0.3
"""Clearly nearer: by more than this factor and distance. A road seen at a flat angle stays within."""
ENLARGEMENT = 1.1
"""Of the boxes behind which nothing is known: they are imprecise."""
_NO_RETURN = torch.iinfo(torch.int64).max


@dataclass(frozen=True)
class Returns:
    """Colored lidar returns."""

    points: Float[Tensor, "n 3"]
    """World, or the frame of a box, meters."""
    colors: Float[Tensor, "n 3"]
    """RGB in [0, 1]."""
    weights: Float[Tensor, " n"]
    """How far they are trusted, in [0, 1]."""

    def __len__(self) -> int:
        return self.points.shape[0]

    def at(self, rows: Int[Tensor, " k"]) -> "Returns":
        return Returns(self.points[rows], self.colors[rows], self.weights[rows])

    @staticmethod
    def concatenate(parts: "Sequence[Returns]") -> "Returns":
        """The rows of all parts in order."""
        if not parts:
            return Returns(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
        return Returns(
            torch.cat([part.points for part in parts]),
            torch.cat([part.colors for part in parts]),
            torch.cat([part.weights for part in parts]),
        )


@dataclass(frozen=True)
class Target:
    """What is known of an image. Where the weight is 0, the other numbers mean nothing."""

    depth: Float[Tensor, "h w"]
    """Along the optical axis, meters."""
    color: Float[Tensor, "h w 3"]
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
        return Target(torch.ones(shape), torch.zeros(*shape, 3), torch.zeros(shape))
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
        returns.colors[row].view(*found.shape, 3),
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
    """Whether the line from the camera to a point meets one of the boxes, by the slabs of Kay and Kajiya (1986).

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
        steps = torch.where(steps.abs() < 1e-6, 1e-6, steps)
        half = 0.5 * ENLARGEMENT * size.to(points)
        sides = ((-half - eye) / steps, (half - eye) / steps)
        enters, leaves = torch.minimum(*sides).amax(1), torch.maximum(*sides).amin(1)
        hidden |= (enters < leaves) & (leaves > 0) & (enters < 1)
    return hidden


def _pixels(camera: Camera, positions: Float[Tensor, "n 2"]) -> Int[Tensor, " n"]:
    column, line = positions.long().unbind(-1)
    return line * camera.width + column
