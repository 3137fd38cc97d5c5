"""What a reader finds in a data set's own files, and the log that follows from it.

A reader decodes files into its data set's own world and stops there. Re-centering, the clock, the window of an object,
depth images and colors of returns are the same for all data sets, and are done here.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import chain, pairwise
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from sparsestreet.data.frame_cache import CacheSize, FrameCache, MemoryForecast, cache_bytes
from sparsestreet.data.images import (
    GivenMasks,
    image_notes,
    joined,
    read_transparent,
)
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.lidar import color_points, depth_image, seen_points
from sparsestreet.data.log import DrivingLog, SceneExtent, VehiclePath, absence_notes
from sparsestreet.data.poses import PosePath, dataset_from_world, recentered
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.data.reader import LogReader, check_region
from sparsestreet.data.recorded_images import RecordedImage
from sparsestreet.data.rig import RigCamera, rig_camera
from sparsestreet.data.timestamps import LogClock
from sparsestreet.data.tracks import checked_track, repeated, timed_tracks, track_in_window
from sparsestreet.geometry.boxes import CarriedPoints, without_frames
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import MASK_KINDS, Frame, MaskSource, SparsePoints, Sweep, Track, View

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
        origins: Callable[[int], Float64[Tensor, "3"] | None] = lambda index: None,
        read_intensities: Callable[[int], Float[Tensor, " n"] | None] = lambda index: None,
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
            origins: where the lidar of a frame index stood, in the log's world; None: nobody knows.
            read_intensities: of the points of a frame index, in [0, 1]; None: the log has none.
        """
        self._cache_bytes = cache_bytes
        self._views: dict[int, list[View]] = {}
        for view in views:
            self._views.setdefault(view.indices[0], []).append(view)
        self._read_pixels = read_frame
        self._clock = clock
        self._sweep_stamps = sweep_stamps or {}
        self._check = check
        self._read_points = read_points
        self._origins, self._read_intensities = origins, read_intensities
        self._use(tracks, frozenset())

    def _use(self, tracks: Sequence[Track], held_out: frozenset[int]) -> None:
        """Set the objects that carry points, and forgets what others carried."""
        self._tracks, self._others, self._held_out = tuple(tracks), without_frames(tracks, held_out), held_out
        self._frames = FrameCache(self._read_frame, self._cache_bytes)
        # The cameras of one instant are mostly asked for in a row, and look at the same points.
        read = self._read_points
        self._points = None if read is None else lru_cache(maxsize=1)(self._carried(read))

    def carried_by(self, tracks: Sequence[Track], held_out: frozenset[int]) -> tuple[Frames, Sweeps]:
        """Frames and sweeps whose points these objects carry; those of other instants depend on no box held out."""
        other = copy(self)
        other._use(tracks, held_out)
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
            lambda index: self._explained(lambda: self._read_intensities(index)),
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
        index = points.frame
        moment, origin = self._moment(index), self._origins(index)
        return Sweep(index, points.time, points.points, colors, colored, *moment, origin)

    def _moment(self, index: int) -> tuple[float | None, int | None]:
        """Seconds and stamp of a sweep."""
        return self._clock.moment(index, self._sweep_stamps.get(index))


@dataclass(frozen=True)
class LidarSweep:
    """The returns of one instant, of all lidars together."""

    read: Callable[[], Float64[Tensor, "n 3"]]
    """Points in the data set's own world, meters, the sensor's motion taken out. Raises LogError for broken files."""
    stamp: int | None = None
    """Nanoseconds at which the points are where they are."""
    origin: Float64[Tensor, "3"] | None = None
    """Where the lidar stood then (of several: the main one), in the data set's own world; None: it is not told."""
    intensities: Callable[[], Float[Tensor, " n"]] | None = None
    """Reads those of the points, in [0, 1]; None: the data set has none. Raises as ``read``."""


@dataclass(frozen=True)
class Boxes:
    """One annotated object."""

    name: str
    """Unique in the log."""
    class_name: str
    """As the data set calls it."""
    frames: np.ndarray
    """f integer instants that its boxes belong to, in the window's count, strictly increasing. Those outside of the
    window (negative, or behind its end) are dropped later."""
    poses: np.ndarray
    """f x 4 x 4 world_from_object in the data set's own world: x along the length, y left, z up, from the center."""
    sizes: np.ndarray
    """f x 3 length, width, height, meters."""
    path: Path
    """The file that they are from."""
    stamps: tuple[int, ...] | None = None
    """f, nanoseconds at which the object was there; None: at the stamps of its frames."""


@dataclass(frozen=True)
class Recording:
    """What was found of the wanted part of a log."""

    name: str
    rig: Sequence[RigCamera]
    shots: Sequence[RecordedImage]
    """Ordered by (frame, camera); an instant may lack cameras."""
    read_image: Callable[[RecordedImage], UInt8[Tensor, "h w 3"]]
    """At the size of the rig's camera. Raises LogError for a broken file."""
    read_masks: Callable[[RecordedImage], Mapping[str, Bool[Tensor, "h w"]]]
    """Those of MASK_KINDS that the image has."""
    mask_kinds: Mapping[str, MaskSource] = field(default_factory=dict)
    """Kind that the log has at all -> whose masks they are."""
    frame_stamps: tuple[int, ...] | None = None
    """Stamp of each instant; None: the data set has no clock."""
    sweeps: Mapping[int, LidarSweep] | None = None
    """Instant -> its sweep; None: no lidar."""
    boxes: Sequence[Boxes] | None = None
    """None: the data set has no annotations."""
    annotated: frozenset[int] | None = None
    """Instants that the data set annotates, also those outside of the window; None: all. In between an object is on its
    way from one to the next if both have it; boxes need stamps then."""
    sparse_points: Callable[[], tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]] | None = None
    """Positions in the data set's own world and RGB in [0, 1] of points that came with it, such as COLMAP's. Those that
    are not finite are left out later."""
    points_file: Path | None = None
    """Where they are from."""
    vehicle: PosePath | None = None
    """The car in the data set's own world, x ahead, y left, z up; None: the data set does not tell."""
    notes: tuple[str, ...] = ()
    """What a user should know about how it was read, one sentence each."""


@dataclass(frozen=True, kw_only=True)
class RecordedReader(LogReader):
    """A data set as its publisher ships it. Subclasses say how to find and decode its files."""

    root: Path | str
    cameras: Sequence[str] | None = None
    """Names as the data set has them; None: the reader's usual ones."""
    first_frame: int = 0
    last_frame: int = -1
    """Included; -1: to the end."""
    width: int | None = None
    """Pixels; every image is scaled to it at its own aspect, and the intrinsics with it. None: as recorded."""
    lidar: bool = True
    """False: as if the log had none."""
    masks: Path | str | None = None
    """Folder of masks that somebody made: ``sky``, ``human``, ``vehicle``, ``ego``, in each a folder a camera, in it
    PNGs with the stems of the images, white where the kind is. None: those of the data set, if it has any."""
    undistort: bool = False
    """Whether every lens is taken out of images and masks as they are read (``DriveStudioReader``)."""
    lidar_ahead: Sequence[float | int] | None = None
    """Meters ahead of the vehicle, least and most, of the returns that are read; None: all. A note says where the log
    does not know its vehicle."""
    extent: SceneExtent = "world"
    """Where the scene's box lies (``DrivingLog.first_axes``): "world" or "first_pose"."""
    cache_mb: CacheSize = "auto"
    """Decoded frames kept in memory, MB (1e6 bytes)."""

    first_pose_of: ClassVar[str] = "vehicle"
    """Whose pose the first one is, where the log knows its vehicle; "camera": as DriveStudio's layout has it."""

    def __post_init__(self) -> None:
        check_region(self.extent, self.lidar_ahead)

    @property
    def folder(self) -> Path:
        return Path(self.root)

    @property
    def given(self) -> GivenMasks:
        """Masks that somebody made."""
        return GivenMasks(None if self.masks is None else Path(self.masks))

    def watched(self) -> Iterator[Path]:
        yield from super().watched()
        if self.masks is not None:
            yield from Path(self.masks).rglob("*.png")

    @abstractmethod
    def recording(self) -> Recording:
        """What is in the files, nothing large decoded. Raises LogError with every problem found, ValueError where the
        wanted part is not there."""

    def check_contents(self) -> list[Problem]:
        """What is wrong with images, masks and points, all of which are decoded, one at a time."""
        recording = self.recording()
        problems: list[Problem] = []
        for shot in recording.shots:
            attempt(problems, partial(recording.read_image, shot))
            attempt(problems, partial(recording.read_masks, shot))
        for sweep in (recording.sweeps or {}).values():
            attempt(problems, sweep.read)
        if recording.sparse_points is not None:
            attempt(problems, recording.sparse_points)
        return list(dict.fromkeys(problems))  # many images may have one mask

    def pinhole(
        self, name: str, index: int, intrinsics: Float64[Tensor, "3 3"], recorded_size: tuple[int, int]
    ) -> RigCamera[str]:
        """A camera whose images are shipped without a lens; arguments as in ``rig_camera``."""
        none = torch.zeros(5, dtype=torch.float64)
        return rig_camera(
            name, index, intrinsics=intrinsics, distortion=none, recorded_size=recorded_size, width=self.width
        )

    def check(self) -> list[Problem]:
        try:
            self.read()
        except LogError as error:
            return list(error.problems)
        return self.check_contents()

    def read(self) -> DrivingLog:
        recording = self.recording()
        recording = replace(recording, notes=(*recording.notes, *self._pixel_notes(recording)))
        if self.lidar_ahead is not None:
            recording = ahead_only(recording, self.lidar_ahead)
        log = log_of(recording, cache_bytes=cache_bytes(self.cache_mb), check=self.check_contents)
        return replace(log, first_axes=self._first_axes(recording)) if self.extent == "first_pose" else log

    def _first_axes(self, recording: Recording) -> Float64[Tensor, "3 3"]:
        path = recording.vehicle if self.first_pose_of == "vehicle" else None
        first = recording.shots[0].world_from_camera if path is None else path.poses[0]
        return first[:3, :3]

    def _pixel_notes(self, recording: Recording) -> Iterator[str]:
        """Of images, by their headers."""
        for camera in recording.rig:
            own = [shot for shot in recording.shots if shot.camera == camera.index]
            yield from image_notes(camera.name, [path for shot in own if (path := shot.path) is not None])


def ahead_only(recording: Recording, ahead: Sequence[float | int]) -> Recording:
    """Return the recording with the returns whose x in the vehicle's frame, meters, lies between the two numbers; with
    a note where there are none, or the vehicle is unknown, and nothing is cut.

    The vehicle is where it was at the stamp of the sweep, or at the nearest instant at which it is known.
    """
    path, sweeps, stamps = recording.vehicle, recording.sweeps, recording.frame_stamps
    if sweeps is None or path is None or stamps is None:
        why = "no lidar is read" if sweeps is None else "the log does not tell where its vehicle was"
        note = f"lidar_ahead={list(ahead)} has no effect: {why}"
        return replace(recording, notes=(*recording.notes, note))

    def kept(sweep: LidarSweep, stamp: int, values: Callable[[], Float[Tensor, "n ..."]]) -> Float[Tensor, "k ..."]:
        when = torch.tensor([stamp]).clamp(path.stamps[0], path.stamps[-1])
        x = transform_points(inverse(path.at(when)[0]), sweep.read())[:, 0]
        return values()[(x > ahead[0]) & (x < ahead[1])]

    def cut(sweep: LidarSweep, stamp: int) -> LidarSweep:
        some = None if sweep.intensities is None else partial(kept, sweep, stamp, sweep.intensities)
        return replace(sweep, read=partial(kept, sweep, stamp, sweep.read), intensities=some)

    # Behind the last image there are no frames, and no sweep is read.
    ahead_of = {
        index: cut(sweep, stamps[index] if sweep.stamp is None else sweep.stamp)
        for index, sweep in sweeps.items()
        if index < len(stamps)
    }
    return replace(recording, sweeps=ahead_of)


def log_of(recording: Recording, *, cache_bytes: int | None, check: Callable[[], list[Problem]]) -> DrivingLog:
    """The log whose world has the data set's axes and its origin at the first camera of the first instant.

    Args:
        recording: what was found.
        cache_bytes: of decoded frames that are kept in memory; None: as ``FrameCache`` has it.
        check: finds everything that is wrong with pixels and points; it is asked once something is.

    Raises LogError for boxes that cannot be.
    """
    num_frames = 1 + max(shot.frame for shot in recording.shots)
    origin = recording.shots[0].world_from_camera[:3, 3]
    recording = replace(recording, boxes=_filled(recording))
    boxes = [_checked(each) for each in recording.boxes or ()]
    if twice := repeated([each.name for each in recording.boxes or ()]):
        file = next(each.path for each in recording.boxes or () if each.name == twice)
        raise fault(file, f"two objects are named {twice!r}", "give each object one name and one list of boxes")
    clock = _clock(recording, num_frames)
    views = [_view(shot, recording.rig, origin, clock) for shot in recording.shots]
    found = [track_in_window(track, range(num_frames), origin) for track in boxes]
    tracks = timed_tracks(
        [track for track in found if track is not None], clock, views, _box_stamps(recording, num_frames)
    )
    shots = {(shot.frame, shot.camera): shot for shot in recording.shots}
    folder = SceneFolder(
        views,
        partial(_frame, recording, shots),
        None if recording.sweeps is None else partial(_points, recording.sweeps, origin),
        clock=clock,
        cache_bytes=cache_bytes,
        check=check,
        tracks=tracks,
        sweep_stamps=_sweep_stamps(recording, num_frames),
        origins=partial(_origin, recording.sweeps or {}, origin),
        read_intensities=partial(_intensities, recording.sweeps or {}),
    )
    return DrivingLog(
        name=recording.name,
        frames=folder.frames,
        sweeps=folder.sweeps,
        tracks=tracks,
        num_frames=num_frames,
        num_cameras=len(recording.rig),
        camera_names=tuple(str(camera.name) for camera in recording.rig),
        dataset_from_world=dataset_from_world(origin),
        carried_by=folder.carried_by,
        sparse_points=None if recording.sparse_points is None else cache(partial(_sparse_points, recording, origin)),
        is_annotated=recording.boxes is not None,
        masks=recording.mask_kinds,
        vehicle=_vehicle(recording.vehicle, origin),
        notes=(
            *_absent(recording),
            *(camera.note for camera in recording.rig if camera.note),
            *_size_notes(recording.boxes or ()),
            *recording.notes,
        ),
    )


def _vehicle(path: PosePath | None, origin: Float64[Tensor, "3"]) -> VehiclePath | None:
    return None if path is None else VehiclePath(recentered(path.poses, origin), tuple(path.stamps.tolist()))


def _clock(recording: Recording, num_frames: int) -> LogClock:
    """Of frames, images, sweeps and boxes of the window."""
    if recording.frame_stamps is None:
        return LogClock(num_frames)
    others = [shot.stamp for shot in recording.shots if shot.stamp is not None]
    others += _sweep_stamps(recording, num_frames).values()
    others += chain.from_iterable(_box_stamps(recording, num_frames).values())
    return LogClock(num_frames, recording.frame_stamps, others)


def _sweep_stamps(recording: Recording, num_frames: int) -> dict[int, int]:
    sweeps = recording.sweeps or {}
    return {index: sweep.stamp for index, sweep in sweeps.items() if sweep.stamp is not None and index < num_frames}


def _box_stamps(recording: Recording, num_frames: int) -> dict[str, list[int]]:
    """Name of an object -> stamps of its boxes in the window, if they have any of their own."""
    return {
        each.name: [stamp for frame, stamp in zip(each.frames, each.stamps, strict=True) if 0 <= frame < num_frames]
        for each in recording.boxes or ()
        if each.stamps is not None
    }


def _filled(recording: Recording) -> Sequence[Boxes] | None:
    """The boxes, and those at instants of the window that are not annotated."""
    if recording.annotated is None or recording.frame_stamps is None:
        return recording.boxes
    return [_with_boxes_between(each, recording.annotated, recording.frame_stamps) for each in recording.boxes or ()]


def _with_boxes_between(boxes: Boxes, annotated: frozenset[int], frame_stamps: tuple[int, ...]) -> Boxes:
    """Centers on a line, rotations on the shorter arc, sizes of the box before."""
    assert boxes.stamps is not None  # as Recording.annotated demands
    place, order = {int(frame): row for row, frame in enumerate(boxes.frames)}, sorted(annotated)
    new = [
        (frame, place[before])
        for before, behind in pairwise(order)
        if before in place and behind in place
        for frame in range(max(before + 1, 0), min(behind, len(frame_stamps)))
    ]
    if not new:
        return boxes
    path = PosePath(torch.tensor(boxes.stamps), torch.from_numpy(boxes.poses))
    at = [frame_stamps[frame] for frame, _ in new]
    frames = np.concatenate((boxes.frames, [frame for frame, _ in new]))
    rows = np.argsort(frames, kind="stable")
    return replace(
        boxes,
        frames=frames[rows],
        poses=np.concatenate((boxes.poses, path.at(torch.tensor(at)).numpy()))[rows],
        sizes=np.concatenate((boxes.sizes, boxes.sizes[[row for _, row in new]]))[rows],
        stamps=tuple((*boxes.stamps, *at)[row] for row in rows),
    )


def _checked(boxes: Boxes) -> Track:
    """The object in all of its frames. Raises LogError for boxes that cannot be."""
    track = checked_track(
        boxes.name, boxes.class_name, boxes.frames, boxes.poses, boxes.sizes, path=boxes.path, num_frames=None
    )
    stamps = boxes.stamps
    if stamps is not None and (len(stamps) != len(boxes.frames) or any(a >= b for a, b in pairwise(stamps))):
        message = f"object {boxes.name} has {len(boxes.frames)} boxes, and {len(stamps)} stamps or some out of order"
        raise fault(boxes.path, message, "write a stamp for each box, in the order of time")
    return track


def _view(shot: RecordedImage, rig: Sequence[RigCamera], origin: Float64[Tensor, "3"], clock: LogClock) -> View:
    camera = rig[shot.camera].at(recentered(shot.world_from_camera, origin))
    camera = replace(camera, shutter=shot.shutter, exposure=shot.exposure or 0.0)
    return clock.view(camera, shot.frame, shot.camera, shot.stamp)


def _frame(recording: Recording, shots: Mapping[tuple[int, int], RecordedImage], view: View) -> Frame:
    shot = shots[view.indices]
    masks = dict(recording.read_masks(shot))
    camera = recording.rig[shot.camera]
    hidden = None if shot.path is None else read_transparent(shot.path, camera.size, camera.undistortion)
    ego = camera.not_of_the_street(joined(masks.pop("ego", None), hidden))
    others = {kind: masks.get(kind) for kind in MASK_KINDS if kind != "ego"}
    return Frame.of(view, image=recording.read_image(shot), ego=ego, **others)


def _points(sweeps: Mapping[int, LidarSweep], origin: Float64[Tensor, "3"], index: int) -> Float[Tensor, "n 3"]:
    if index not in sweeps:
        return torch.zeros(0, 3)
    return (sweeps[index].read() - origin).float()


def _intensities(sweeps: Mapping[int, LidarSweep], index: int) -> Float[Tensor, " n"] | None:
    if index not in sweeps:
        return torch.zeros(0)
    read = sweeps[index].intensities
    return None if read is None else read()


def _origin(sweeps: Mapping[int, LidarSweep], origin: Float64[Tensor, "3"], index: int) -> Float64[Tensor, "3"] | None:
    stood = sweeps[index].origin if index in sweeps else None
    return None if stood is None else stood - origin


def _sparse_points(recording: Recording, origin: Float64[Tensor, "3"]) -> SparsePoints:
    assert recording.sparse_points is not None  # else it is not asked
    positions, colors = recording.sparse_points()
    places = (positions - origin).float()
    finite, where = torch.isfinite(places).all(1), f" of {recording.points_file}" if recording.points_file else ""
    notes = []
    if not finite.all():
        lost = torch.nonzero(~finite).flatten()
        notes = [
            f"{len(lost)} of {len(places)} points{where} are not finite, the first is point {int(lost[0])}: left out"
        ]
    if len(colors) and bool((colors == 0.5).all()):
        notes.append(f"the points{where} have no colors that are known (red, green, blue, or f_dc_0): they are gray")
    return SparsePoints(places[finite], colors[finite], tuple(notes))


def _size_notes(objects: Sequence[Boxes]) -> list[str]:
    """One sentence for objects whose boxes differ in size by more than a tenth, and by more than 0.1 m."""
    found = []
    for each in objects:
        least, most = each.sizes.min(0), each.sizes.max(0)
        if ((most > 1.1 * least) & (most - least > 0.1)).any():
            side = int((most / least).argmax())
            name = ("length", "width", "height")[side]
            found.append(f"{each.name}, {name} {least[side]:.2f} to {most[side]:.2f} m")
    if not found:
        return []
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return [f"the boxes of some objects differ in size, their mean is taken: {'; '.join(found[:3])}{more}"]


def _absent(recording: Recording) -> tuple[str, ...]:
    return absence_notes(
        sky="sky" in recording.mask_kinds,
        human="human" in recording.mask_kinds,
        vehicle="vehicle" in recording.mask_kinds,
        lidar=recording.sweeps is not None,
        boxes=recording.boxes is not None,
        clock=recording.frame_stamps is not None,
    )
