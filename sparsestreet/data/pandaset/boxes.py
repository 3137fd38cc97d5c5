"""Objects of a sequence out of the cuboids of its instants."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.pandaset.layout import Layout
from sparsestreet.data.pandaset.spin import Spin
from sparsestreet.data.pandaset.tables import PER_SECOND, Cuboids, read_cuboids
from sparsestreet.data.problems import LogError, Problem, attempt
from sparsestreet.data.recording import Boxes
from sparsestreet.geometry.cameras import inverse, transform_points


@dataclass(frozen=True)
class Objects:
    """What the cuboids of a window are."""

    boxes: list[Boxes]
    stationary: int
    """How many objects stand through all of the scene."""
    twins: int
    """Cuboids left out because another is of the same object at the same instant."""
    crowded: int
    """Cuboids left out because the one before is not earlier."""


@dataclass(frozen=True)
class _Object:
    label: str
    stationary: bool
    frames: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    sizes: list[np.ndarray] = field(default_factory=list)


def read_objects(
    layout: Layout,
    frames: Sequence[int],
    stamps: Sequence[int],
    world_from_lidar: Float64[Tensor, "f 4 4"],
    spin: Spin | None,
) -> Objects:
    """The objects of a window; raises LogError with all files that are broken.

    Args:
        layout: the sequence.
        frames: of the window, as files are numbered.
        stamps: of the sweeps of the window.
        world_from_lidar: at these stamps.
        spin: when the lidar passed a direction, which is when a box was where it is; None: at the stamp of its sweep.
    """
    objects: dict[str, _Object] = {}
    problems: list[Problem] = []
    twins = crowded = 0
    for index, frame in enumerate(frames):
        cuboids = attempt(problems, _reading(layout, frame))
        if cuboids is None:
            continue
        twins += cuboids.twins
        moments = stamps[index] + _delays(cuboids, world_from_lidar[index], spin)
        for row, name in enumerate(cuboids.names):
            one = objects.setdefault(name, _Object(cuboids.labels[row], bool(cuboids.stationary[row])))
            if one.stamps and moments[row] <= one.stamps[-1]:
                crowded += 1
                continue
            one.frames.append(index)
            one.stamps.append(int(moments[row]))
            one.poses.append(cuboids.poses[row])
            one.sizes.append(cuboids.sizes[row])
    if problems:
        raise LogError(problems)
    boxes = [_boxes(layout, name, one) for name, one in objects.items()]
    return Objects(boxes, sum(one.stationary for one in objects.values()), twins, crowded)


def _reading(layout: Layout, frame: int) -> Callable[[], Cuboids]:
    return lambda: read_cuboids(layout.boxes(frame))


def _delays(cuboids: Cuboids, world_from_lidar: Float64[Tensor, "4 4"], spin: Spin | None) -> np.ndarray:
    """Nanoseconds from the stamp of the sweep to the moment of each box; 0 for those of the other lidar."""
    if spin is None or not cuboids.names:
        return np.zeros(len(cuboids.names), dtype=np.int64)
    centers = transform_points(inverse(world_from_lidar), torch.from_numpy(cuboids.poses[:, :3, 3])).numpy()
    seconds = spin.passing(np.arctan2(centers[:, 1], centers[:, 0]))
    return np.where(cuboids.spinning, np.round(seconds * PER_SECOND), 0).astype(np.int64)


def _boxes(layout: Layout, name: str, one: _Object) -> Boxes:
    return Boxes(
        name=name,
        class_name=one.label,
        frames=np.array(one.frames),
        poses=np.stack(one.poses),
        sizes=np.stack(one.sizes),
        path=layout.cuboids,
        stamps=tuple(one.stamps),
    )
