"""A driving log as the rest of the package sees it, whatever data set it came from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.hood import Hood
from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.data.tracks import repeated
from sparsestreet.geometry.trajectories import frame_periods
from sparsestreet.kept import NOTHING, Kept
from sparsestreet.types import Frame, MaskSource, SparsePoints, Track, View

_ABSENT = {
    "sky": "no sky masks: nothing but the images tells sky from scene, and there is no sky term in the loss",
    "human": "no human masks: there are no metrics of human pixels",
    "vehicle": "no vehicle masks: there are no metrics of vehicle pixels",
    "lidar": "no lidar: Gaussians start from points in images and random ones, and there is no depth term in the loss",
    "boxes": "no boxes: nothing is modeled as moving, whatever moves becomes part of the background",
    "clock": "no clock: the frame rate is unknown, and a video plays at the one that log_fps says",
}


def counted(number: int, noun: str) -> str:
    """Return both, the noun in the plural unless there is one.

    >>> counted(1, "sweep"), counted(2, "sweep")
    ('1 sweep', '2 sweeps')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def absence_notes(*, sky: bool, human: bool, vehicle: bool, lidar: bool, boxes: bool, clock: bool) -> tuple[str, ...]:
    """A sentence for each part that a log does not have, of which a reader says for each whether it is there."""
    present = {"sky": sky, "human": human, "vehicle": vehicle, "lidar": lidar, "boxes": boxes, "clock": clock}
    return tuple(sentence for part, sentence in _ABSENT.items() if not present[part])


_QUANTILES = (0.02, 0.98)
_FLATTEST = 0.01
"""Shortest side of the scene's box over its longest one: a log of one height would divide by zero."""
_MARGIN = 1.1
_SEEN_AHEAD = 50.0
"""Meters a camera is taken to see where no lidar says so."""
_QUANTILE_POINTS = 1_000_000
"""Quantiles of this many points are as good as of all of them, and take a tenth of a second."""


SceneExtent = Literal["world", "first_pose"]
"""The axes of the scene's box: those of the world, or those of the first pose (``DrivingLog.first_axes``)."""
_FIRST_POSE_REACH = 20.0
"""Meters along the last axis of the first pose (Waymo: up) that the box reaches at least (DriveStudio)."""

Truth = Callable[[View], Frame | None]
"""A view of the log's world -> the frame that its camera would have recorded; None where none can be, as inside of a
car."""


@dataclass(frozen=True)
class VehiclePath:
    """Where the recording car was: x ahead, y left, z up."""

    poses: Float64[Tensor, "p 4 4"]
    """world_from_vehicle, in the re-centered world; the origin is the data set's, mostly the rear axle."""
    stamps: tuple[int, ...] | None = None
    """Nanoseconds on the log's clock, increasing, one a pose; None: the poses are those of the frames, one each."""


@dataclass(frozen=True)
class DrivingLog:
    """Frames, lidar sweeps and object tracks of one drive in one metric world, re-centered near its start."""

    name: str
    frames: Frames
    """Ordered by (frame_index, camera_index), decoded when indexed; ``as_frames`` takes frames that are in memory."""
    sweeps: Sweeps
    """Ordered by index, read when indexed; ``Sweeps.of(())`` where the log has no lidar."""
    tracks: tuple[Track, ...]
    """Objects with a box in at least one of the frames; poses are in the re-centered world."""
    num_frames: int
    """Instants, not images: frame indices run over 0 .. num_frames - 1."""
    num_cameras: int
    dataset_from_world: Float64[Tensor, "4 4"]
    """Adds back what re-centering took away: maps the log's world to the data set's own."""
    notes: tuple[str, ...] = ()
    """What is absent, and what a run does without it, one sentence each."""
    truth: Truth | None = None
    """What a camera off the recorded path would see; None: unknown, as for any recorded drive."""
    first_axes: Float64[Tensor, "3 3"] | None = None
    """Axes of the first pose, as columns in the world; center and radius are then those of DriveStudio: of a box along
    these axes around the lidar alone. They do not depend on where the street leads. None: the box lies along the axes
    of the world, and holds the cameras too."""
    camera_names: tuple[str, ...] = ()
    """As the data set calls them, by camera index; empty: they have none but their indices."""
    sparse_points: Callable[[], SparsePoints] | None = None
    """Reads points that came with the log, where it has any. Gaussians start from them, and without lidar the scene's
    box lies around them; they are no returns, so they give no depth."""
    carried_by: Callable[[Sequence[Track], frozenset[int]], tuple[Frames, Sweeps]] | None = None
    """Makes frames and sweeps whose points these objects carry from one time to another; those of instants that are not
    held out depend on no box of one that is. None: no box carries a point."""

    masks: Mapping[str, MaskSource] | None = None
    """Kind of masks (``MASK_KINDS``) that the log has -> whose they are; None: the reader does not tell."""
    is_annotated: bool = True
    """Whether somebody has looked for objects in it, though there may be none."""
    vehicle: VehiclePath | None = None
    """None: the log tells where its cameras were, but not the car that carried them."""
    kept: Kept = field(default=NOTHING, compare=False)
    """What earlier runs found out about this very log; who changes its frames or boxes takes a new one. By default
    nothing is kept."""

    def __post_init__(self) -> None:
        """Raise ValueError where two objects have one name: layouts and nodes know them by it."""
        if twice := repeated([track.name for track in self.tracks]):
            raise ValueError(f"objects of a log have different names, {twice!r} stands twice: rename one of them")

    def holding_out(self, frames: frozenset[int]) -> "DrivingLog":
        """The log, where depth and colors of other frames depend on no box of these.

        Images are taken at other times than sweeps, and a box on the way to the next one carries returns from one time
        to the other (``geometry.boxes.box_at``).
        """
        if self.carried_by is None or not frames:
            return self
        kept, sweeps = self.carried_by(self.tracks, frames)
        return replace(self, frames=kept, sweeps=sweeps)

    def with_tracks(self, tracks: Sequence[Track]) -> "DrivingLog":
        """The log with these objects in the place of its own: they carry its returns, and have answers of their own.

        Raises ValueError where two have one name.
        """
        notes = tuple(note for note in self.notes if not tracks or note != _ABSENT["boxes"])
        others = replace(self, tracks=tuple(tracks), notes=notes, kept=self.kept.within("tracks", tracks))
        if self.carried_by is None:
            return others
        frames, sweeps = self.carried_by(tracks, frozenset())
        return replace(others, frames=frames, sweeps=sweeps)

    hoods: Mapping[int, Hood] = field(default_factory=dict)
    """Camera index -> what it was found to see of the car that carries it (``hood.find_hoods``)."""
    dirt: Mapping[int, Hood] = field(default_factory=dict)
    """Camera index -> what was found on its lens (``dirt.find_dirt``)."""

    @property
    def views(self) -> tuple[View, ...]:
        """Cameras, times and indices of the frames, for whoever needs no pixels: none is decoded."""
        return self.frames.views

    @cached_property
    def seconds(self) -> dict[int, float]:
        """Frame index -> seconds of the first of its views since the log's first stamp; empty without a clock."""
        first = self._first_views().items()
        return {index: view.seconds for index, (_, view) in first if view.seconds is not None}

    @cached_property
    def stamps(self) -> dict[int, int]:
        """Frame index -> stamp of the first of its views, nanoseconds on the log's clock; empty without a clock."""
        return {index: stamp for index, (stamp, _) in self._first_views().items()}

    @property
    def frame_rate(self) -> float | None:
        """Frames a second, from the first to the last; None without a clock, and of a log of one frame.

        The mean step, not the median: a video of all frames then lasts as long as the drive, and stamps that were
        rounded (KITTI's converted ones, to 10 ms) do not bias it.
        """
        if len(self.stamps) < 2:
            return None
        first, last = min(self.stamps), max(self.stamps)
        return 1e9 * (last - first) / (self.stamps[last] - self.stamps[first])

    @cached_property
    def frame_periods(self) -> float:
        """How many frames' worth normalized time 0 to 1 is; num_frames - 1 if frames are evenly spaced."""
        return frame_periods(self.views)

    def _first_views(self) -> dict[int, tuple[int, View]]:
        """Frame index -> the lowest stamp and the view with it; empty where some view has none."""
        first: dict[int, tuple[int, View]] = {}
        for view in self.views:
            if view.stamp is None:
                return {}
            index, _ = view.indices
            if index not in first or view.stamp < first[index][0]:
                first[index] = view.stamp, view
        return first

    @cached_property
    def _bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        return self.kept.get("bounds", (), self._measured_bounds)

    def _measured_bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Corners of the box around the camera centers and the 2 % to 98 % quantiles of the lidar points.

        Points that some camera sees count (DriveStudio's rule); without lidar, the points that came with the log, and
        without these what lies 50 m ahead of each camera.
        Along ``first_axes``, if given: there the lidar alone counts, and the box reaches 20 m along the last axis.
        """
        points = self._along_axes(_seen_points(self.sweeps))
        if not len(points) and self.sparse_points is not None:
            points = self._along_axes(self.sparse_points().positions.numpy())
        if len(points) and self.first_axes is not None:
            low, high = np.quantile(points, _QUANTILES, axis=0)
            high[2] = max(high[2], _FIRST_POSE_REACH)
            return low, high
        centers = self._along_axes(torch.stack([view.camera.position for view in self.views]).double().numpy())
        low, high = centers.min(axis=0), centers.max(axis=0)
        if len(points):
            around = np.quantile(points, _QUANTILES, axis=0)
        else:
            # The third row of camera_from_world is the optical axis in the world.
            axes = torch.stack([view.camera.camera_from_world[2, :3] for view in self.views]).double().numpy()
            ahead = centers + _SEEN_AHEAD * self._along_axes(axes)
            around = np.stack((ahead.min(axis=0), ahead.max(axis=0)))
        return np.minimum(low, around[0]), np.maximum(high, around[1])

    def _along_axes(self, vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return vectors if self.first_axes is None else vectors @ self.first_axes.numpy()

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Middle of the scene's box in the world, meters."""
        low, high = self._bounds
        middle = torch.from_numpy((low + high) / 2)
        return (middle if self.first_axes is None else self.first_axes @ middle).float()

    @property
    def box_from_world(self) -> Float[Tensor, "3 4"]:
        """Affine map of the world, meters, that takes the scene's box to [-1, 1] along its own axes.

        A flat box counts as a hundredth as high as it is long.
        """
        low, high = self._bounds
        half = torch.from_numpy(np.maximum(high - low, _FLATTEST * float((high - low).max())) / 2)
        turned = torch.eye(3, dtype=torch.float64) if self.first_axes is None else self.first_axes.T
        middle = torch.from_numpy((low + high) / 2)
        return torch.cat((turned, -middle[:, None]), 1).div(half[:, None]).float()

    @property
    def radius(self) -> float:
        """Size of the scene in meters: 1.1 times half the longest side of its box (DriveStudio's scene radius)."""
        low, high = self._bounds
        return _MARGIN * float((high - low).max()) / 2


@dataclass(frozen=True)
class Split:
    """Which images are trained on and which are only looked at; no image is in both."""

    train: Frames
    held_out: Frames

    @property
    def held_out_indices(self) -> frozenset[int]:
        """Integer frames whose images, sweeps and boxes must not be trained on: those without an image to train on."""
        trained = {view.indices[0] for view in self.train.views}
        return frozenset(view.indices[0] for view in self.held_out.views) - trained


def split(log: DrivingLog, *, stride: int = 10, offset: int = 5, cameras: Sequence[str | int] = ()) -> Split:
    """Hold out every ``stride``-th instant with all its cameras: indices offset, offset + stride, ... Every image of
    ``cameras``, given by name, is held out too.

    ``offset=stride`` starts at ``stride``, so that frame 0 is trained on (DriveStudio's split). ``stride=0`` holds out
    no instant. Raises ValueError where no training frame, or no held-out one, would be left, and for a camera that the
    log lacks. Decodes no image.
    """
    if cameras:
        chosen = _camera_indices(log, cameras)
        others = replace(log, frames=log.frames.where(lambda view: view.camera_index not in chosen))
        if not others.frames:
            raise ValueError(f"split.cameras holds out all cameras of {log.name!r}: leave one to train on")
        parts = split(others, stride=stride, offset=offset)
        trained = {view.indices for view in parts.train.views}
        return Split(parts.train, log.frames.where(lambda view: view.indices not in trained))
    if stride == 0:
        return Split(log.frames, as_frames(()))
    if not 0 <= offset <= stride:
        raise ValueError(
            f"a split needs 0 <= offset <= stride, got split.offset {offset} and split.stride {stride}: offset is the "
            "first frame that is held out, and the next one comes stride frames later"
        )
    instants = frozenset(range(offset, log.num_frames, stride))
    held_out = log.frames.where(lambda view: view.frame_index in instants)
    train = log.frames.where(lambda view: view.frame_index not in instants)
    if not train:
        raise ValueError(
            f"split.stride {stride} holds out all of {counted(log.num_frames, 'frame')} of {log.name!r}: take a larger "
            "one, or say split.stride=0 to train on every frame"
        )
    if not held_out:
        raise ValueError(
            f"split.offset {offset} lies behind the {counted(log.num_frames, 'frame')} of {log.name!r}, so nothing "
            "would be held out: lower split.offset, or say split.stride=0 to train on every frame"
        )
    return Split(train, held_out)


def _camera_indices(log: DrivingLog, cameras: Sequence[str | int]) -> frozenset[int]:
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    if unknown := [camera for camera in cameras if str(camera) not in names]:
        raise ValueError(f"split.cameras names {unknown}, the cameras of {log.name!r} are {', '.join(names)}")
    return frozenset(names.index(str(camera)) for camera in cameras)


def _seen_points(sweeps: Sweeps) -> Float[np.ndarray, "n 3"]:
    """Lidar points that a camera sees, or all where none is seen; every k-th of very many."""
    seen = [sweep.points[sweep.colored] for sweep in sweeps.gray()]
    if not any(map(len, seen)):
        seen = [sweep.points for sweep in sweeps.gray()]
    return _every(sum(map(len, seen)) // _QUANTILE_POINTS + 1, seen)


def _every(step: int, parts: Sequence[Float[Tensor, "_ 3"]]) -> Float[np.ndarray, "n 3"]:
    """Every ``step``-th point of all parts together, counted from the first, without a copy of them all."""
    taken = [np.zeros((0, 3), dtype=np.float32)]
    passed = 0
    for part in parts:
        taken.append(part[-passed % step :: step].numpy())
        passed += len(part)
    return np.concatenate(taken)
