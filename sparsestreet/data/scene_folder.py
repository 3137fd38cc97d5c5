"""A log on disk: its views are known at once, its images and points are read when a frame or a sweep is asked for."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.data.clock import LogClock
from sparsestreet.data.frame_cache import FrameCache, LruCache, MemoryForecast
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.lidar import color_points, depth_image, seen_points
from sparsestreet.data.problems import LogError, Problem
from sparsestreet.geometry.boxes import CarriedPoints, without_frames
from sparsestreet.types import Frame, Sweep, Track, View

T = TypeVar("T")


class SceneFolder:
    """Frames with the lidar depth of their instant, and sweeps in the colors of its images, from what decodes files.

    An image may be taken at another time than the sweep. Depth and colors then come from points that the objects'
    boxes carry from one time to the other.
    """

    def __init__(
        self,
        views: Sequence[View],
        read_frame: Callable[[View], Frame],
        read_points: Callable[[int], Float[Tensor, "n 3"]] | None,
        *,
        clock: LogClock,
        cache_bytes: int | None,
        check: Callable[[], list[Problem]],
        tracks: Sequence[Track] = (),
        sweep_stamps: Mapping[int, int] | None = None,
    ) -> None:
        """
        Args:
            views: of the log, ordered by (frame_index, camera_index), in its re-centered world.
            read_frame: decodes the image and the masks of a view; depth is added here.
            read_points: lidar points of a frame index in the log's world; None: the log has no lidar.
            clock: of the log.
            cache_bytes: of decoded frames that are kept in memory; None: as ``FrameCache`` has it.
            check: finds everything that is wrong with the folder; it is asked once something is.
            tracks: objects that carry points, with the times of their boxes.
            sweep_stamps: frame index -> stamp of its sweep, where that is not the frame's.
        """
        self._cache_bytes = cache_bytes
        self._views: dict[int, list[View]] = {}
        for view in views:
            self._views.setdefault(view.indices[0], []).append(view)
        self._read_pixels = read_frame
        self._clock = clock
        self._tracks = tuple(tracks)
        self._sweep_stamps = sweep_stamps or {}
        self._check = check
        self._read_points = read_points
        self._use(tracks, frozenset())

    def _use(self, others: Sequence[Track], held_out: frozenset[int]) -> None:
        """Sets the objects that carry points of frames which are not held out, and forgets what others carried."""
        self._others, self._held_out = tuple(others), held_out
        self._frames = FrameCache(self._read_frame, self._cache_bytes)
        # The cameras of one instant are mostly asked for in a row, and look at the same points.
        read = self._read_points
        self._points = None if read is None else LruCache(self._carried(read), lambda points: 1, 1)

    def holding_out(self, frames: frozenset[int]) -> tuple[Frames, Sweeps]:
        """Frames and sweeps, of which those of other instants depend on no box of these frames."""
        other = copy(self)
        other._use(without_frames(self._tracks, frames), frames)
        return other.frames, other.sweeps

    @property
    def frames(self) -> Frames:
        """Decoded when indexed; raises LogError then, with all problems of the folder, where a file is broken."""
        return Frames([view for rig in self._views.values() for view in rig], self._frame, self._forecast)

    def _forecast(self) -> MemoryForecast:
        return self._frames.forecast([view.indices for rig in self._views.values() for view in rig])

    @property
    def sweeps(self) -> Sweeps:
        """Read when indexed, and colored by the images of their instant; empty without lidar. Raises as ``frames``."""
        points = self._points
        if points is None:
            return Sweeps.of(())
        return Sweeps(
            self._views,
            lambda index: self._explained(lambda: self._sweep(index, points)),
            lambda index: self._explained(lambda: self._gray_sweep(index, points)),
            {index: stamp for index in self._views if (stamp := self._moment(index)[1]) is not None},
        )

    def _frame(self, view: View) -> Frame:
        return self._explained(lambda: self._frames(view.indices))

    def _explained(self, read: Callable[[], T]) -> T:
        try:
            return read()
        except LogError as error:
            raise LogError(self._check() or error.problems) from error

    def _read_frame(self, key: tuple[int, int]) -> Frame:
        index, camera_index = key
        (view,) = (view for view in self._views[index] if view.camera_index == camera_index)
        frame = self._read_pixels(view)
        if self._points is None:
            return frame
        return replace(frame, depth=depth_image(self._points(index).at(view.time), view.camera, frame.ego))

    def _carried(self, read_points: Callable[[int], Float[Tensor, "n 3"]]) -> Callable[[int], CarriedPoints]:
        def carried(index: int) -> CarriedPoints:
            time = self._clock.time(index, self._sweep_stamps.get(index))
            tracks = self._tracks if index in self._held_out else self._others
            return CarriedPoints(read_points(index), time, index, tracks)

        return carried

    def _sweep(self, index: int, read_points: Callable[[int], CarriedPoints]) -> Sweep:
        frames = [self._frames(view.indices) for view in self._views[index]]
        points = read_points(index)
        places = [points.at(frame.time) for frame in frames]
        colors, colored = color_points(points.points, frames, places)
        return self._timed(points, colors, colored)

    def _gray_sweep(self, index: int, read_points: Callable[[int], CarriedPoints]) -> Sweep:
        """The same without colors, for which no image need be decoded."""
        views, points = self._views[index], read_points(index)
        places = [points.at(view.time) for view in views]
        seen = seen_points(points.points, [view.camera for view in views], places)
        return self._timed(points, torch.full_like(points.points, 0.5), seen)

    def _timed(self, points: CarriedPoints, colors: Float[Tensor, "n 3"], colored: Bool[Tensor, " n"]) -> Sweep:
        return Sweep(points.frame, points.time, points.points, colors, colored, *self._moment(points.frame))

    def _moment(self, index: int) -> tuple[float | None, int | None]:
        """Seconds and stamp of a sweep."""
        return self._clock.moment(index, self._sweep_stamps.get(index))
