"""From a folder in DriveStudio's processed layout to a DrivingLog."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import with_bodies
from sparsestreet.data.drivestudio.contents import (
    check_sweep_size,
    complete,
    first_pose,
    hashed_files,
    pixel_notes,
    pose_files,
    read_clock,
    read_frame,
    read_instances,
    read_intensities,
    read_intrinsics,
    read_points,
    read_pose,
    read_rig,
    read_sweep,
    read_vehicle,
    read_views,
    required_files,
    sweep_notes,
    sweep_origin,
)
from sparsestreet.data.drivestudio.layout import FOLDER_KINDS, FlavorName, Layout, find_layout
from sparsestreet.data.frame_cache import CacheSize, cache_bytes
from sparsestreet.data.images import check_camera_images, image_size
from sparsestreet.data.log import DrivingLog, SceneExtent, VehiclePath, absence_notes
from sparsestreet.data.poses import check_extent, dataset_from_world, recentered
from sparsestreet.data.problems import LogError, Missing, Problem, attempt, check_missing, missing_files, missing_notes
from sparsestreet.data.reader import FolderSignature, LogFiles, LogReader, check_region
from sparsestreet.data.recording import SceneFolder
from sparsestreet.data.rig import check_lens
from sparsestreet.data.tracks import timed_tracks, track_in_window
from sparsestreet.types import Track


def check_layout(layout: Layout, *, contents: bool) -> list[Problem]:
    """Every problem of the frames and cameras that are read; an empty list means that reading will succeed.

    ``contents=False`` is quick: it trusts lidar points of the right size, and images that are not cut short.
    """
    problems = missing_files(required_files(layout))
    for camera in layout.cameras:
        problems += _own(layout.intrinsics(camera), partial(_check_camera, layout, camera))
    problems += _check_poses(layout)
    attempt(problems, partial(read_clock, layout))
    problems += _check_images(layout, contents)
    for frame in layout.frames if layout.has_lidar else ():
        problems += _own(layout.sweep(frame), partial(read_sweep if contents else check_sweep_size, layout, frame))
    return problems


def _own(path: Path, read: Callable[[], object]) -> list[Problem]:
    """Those of the file alone, if it is there: broken images and poses, which are read with it, are reported once."""
    found: list[Problem] = []
    if path.is_file():
        attempt(found, read)
    return [problem for problem in found if problem.path == path]


def _check_camera(layout: Layout, camera: int) -> None:
    intrinsics, distortion = read_intrinsics(layout.intrinsics(camera))
    if distortion.any():
        size = image_size(layout.image(layout.frames[0], camera))
        check_lens(layout.intrinsics(camera), intrinsics, distortion, size)


def _check_poses(layout: Layout) -> list[Problem]:
    """Poses, boxes and bodies, and whether all of them are within one scene."""
    problems: list[Problem] = []
    placed: list[tuple[Path, torch.Tensor]] = []
    for path in filter(Path.is_file, pose_files(layout)):
        pose = attempt(problems, partial(read_pose, path))
        if pose is not None:
            placed.append((path, pose[:3, 3]))
    if layout.flavor.mounted:  # there the extrinsics are relative to the vehicle
        placed = [(path, position) for path, position in placed if path.parent.name == "ego_pose"]
    if layout.instances.is_file():
        tracks = attempt(problems, partial(read_instances, layout)) or []
        placed += [(layout.instances, position) for track in tracks for position in track.world_from_object[:, :3, 3]]
        if layout.bodies.is_file() and tracks:
            attempt(problems, partial(with_bodies, tracks, layout))
    return problems + check_extent(placed)


def _check_images(layout: Layout, contents: bool) -> list[Problem]:
    problems: list[Problem] = []
    for camera in layout.cameras:
        images = [layout.image(frame, camera) for frame in layout.frames]
        masks = [layout.mask(kind, frame, camera) for kind in FOLDER_KINDS for frame in layout.frames]
        masks = [path for path in (*masks, layout.ego_mask(camera)) if path is not None]
        problems += check_camera_images(camera, images, masks, decode=contents)
    return problems


@dataclass(frozen=True)
class DriveStudioReader(LogReader):
    """Frames first_frame .. last_frame (included) of some cameras, of the folder of one scene.

    The world keeps the data set's axes and is shifted, in float64, so that the vehicle (flavors of mounted cameras) or
    the front camera (nuScenes, PandaSet) starts at the origin. Frames are counted from the window's
    start, cameras by their place in ``cameras``. Without a clock time is frame / (frames - 1), 0 in a log of one frame.

    A file ``timestamps.txt`` beside the folders is the clock: the seconds of each frame, one a line, by any zero. All
    cameras and the lidar share the stamp of their frame. A file ``timestamps_C.txt`` (not DriveStudio's) has those of
    the images of camera C, where each has a pose of its own.
    """

    marks = FolderSignature(("images/[0-9][0-9][0-9]_[0-9].jpg", "extrinsics/*.txt"))

    root: Path | str
    cameras: Sequence[int] | None = None
    """None: all."""
    first_frame: int = 0
    last_frame: int = -1
    """-1: to the end."""
    width: int | None = None
    """Pixels; every image is scaled to it at its own aspect, and the intrinsics with it. None: as recorded."""
    lidar: bool = True
    """False: as if the log had none."""
    bodies: bool = True
    """False: as if the log had no body poses of people."""
    undistort: bool = False
    """Whether every lens is taken out of images and masks as they are read (DriveStudio, on Waymo). Cameras are then
    pinholes with the same intrinsics; what they did not record is black, and no loss sees it (``Frame.ego``)."""
    lidar_ahead: Sequence[float | int] | None = None
    """Meters ahead of the vehicle, least and most, of the returns that are read (DriveStudio: -2 and 80); of the Waymo
    flavor only. None: all."""
    extent: SceneExtent = "world"
    """Where the scene's box lies (``DrivingLog.first_axes``): "world" or "first_pose"."""
    flavor: FlavorName | None = None
    """The data set that the layout was made of; None: what the files tell, an error where they leave it open."""
    missing: Missing = "error"
    """skip: frames of which a file is missing are left out with a note."""
    cache_mb: CacheSize = "auto"
    """Decoded frames kept in memory, MB (1e6 bytes)."""

    def __post_init__(self) -> None:
        check_missing(self.missing)
        check_region(self.extent, self.lidar_ahead)

    @property
    def folder(self) -> Path:
        return Path(self.root)

    def check(self) -> list[Problem]:
        """Every problem of the chosen cameras and frames, pixels and lidar points among them, which are all decoded."""
        try:
            return check_layout(self._layout(), contents=True)
        except LogError as error:
            return list(error.problems)

    def read(self) -> DrivingLog:
        layout = self._layout()
        problems = check_layout(layout, contents=False)
        if problems:
            raise LogError(problems)
        start = first_pose(layout)
        origin = start[:3, 3]
        tracks, people = _read_tracks(layout, origin)
        clock, rig = read_clock(layout), read_rig(layout, self.width, self.undistort)
        views = read_views(layout, rig, origin, clock)
        tracks = timed_tracks(tracks, clock, views)
        folder = SceneFolder(
            views,
            partial(read_frame, layout, rig),
            partial(read_points, layout, origin, self.lidar_ahead) if layout.has_lidar else None,
            clock=clock,
            cache_bytes=cache_bytes(self.cache_mb),
            check=lambda: check_layout(layout, contents=True),
            tracks=tracks,
            origins=cache(partial(sweep_origin, layout, origin)),  # rows of Waymo are read for it
            read_intensities=partial(read_intensities, layout, self.lidar_ahead),
        )
        return DrivingLog(
            name=layout.root.resolve().name,
            frames=folder.frames,
            sweeps=folder.sweeps,
            tracks=tracks,
            num_frames=len(layout.frames),
            num_cameras=len(rig),
            camera_names=tuple(str(camera.name) for camera in rig),
            dataset_from_world=dataset_from_world(origin),
            carried_by=folder.carried_by,
            masks=layout.mask_sources,
            is_annotated=layout.has_instances,
            notes=(
                *_notes(layout),
                *self._without_effect(layout),
                *(camera.note for camera in rig if camera.note is not None),
                *people,
                *pixel_notes(layout),
                *sweep_notes(layout),
            ),
            first_axes=start[:3, :3] if self.extent == "first_pose" else None,
            vehicle=VehiclePath(recentered(read_vehicle(layout), origin)) if layout.flavor.mounted else None,
        )

    def files(self) -> LogFiles:
        """Those of the chosen frames and cameras, of every kind that the folder has."""
        return hashed_files(self._layout())

    def _without_effect(self, layout: Layout) -> list[str]:
        """Options that were asked for, and change nothing of this folder."""
        if self.lidar_ahead is None or (layout.has_lidar and layout.flavor.name == "waymo"):
            return []
        why = f"returns of the flavor {layout.flavor.name} are not cut" if layout.has_lidar else "no lidar is read"
        return [f"lidar_ahead={list(self.lidar_ahead)} has no effect: {why}"]

    def _layout(self) -> Layout:
        layout = find_layout(
            self.folder,
            cameras=self.cameras,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
            lidar=self.lidar,
            bodies=self.bodies,
            flavor=self.flavor,
        )
        return complete(layout) if self.missing == "skip" else layout


def _read_tracks(layout: Layout, origin: Float64[Tensor, "3"]) -> tuple[tuple[Track, ...], tuple[str, ...]]:
    """The objects in the window, and what has to be said about their body poses."""
    if not layout.has_instances:
        return (), ()
    tracks, notes = with_bodies(read_instances(layout), layout)
    windows = [track_in_window(track, layout.frames, origin) for track in tracks]
    return tuple(track for track in windows if track is not None), notes


def _notes(layout: Layout) -> tuple[str, ...]:
    sky, human, vehicle = (layout.mask_folder(kind) is not None for kind in ("sky", "human", "vehicle"))
    absent = absence_notes(
        sky=sky,
        human=human,
        vehicle=vehicle,
        lidar=layout.has_lidar,
        boxes=layout.has_instances,
        clock=layout.has_clock,
    )
    skipped = missing_notes(layout.absent, layout.absent + len(layout.frames), "frames")
    return (*skipped, *_note_of_flavor(layout), *absent)


def _note_of_flavor(layout: Layout) -> list[str]:
    """How a folder is read that is of neither data set which DriveStudio began with."""
    flavor = layout.flavor
    if flavor.name in ("waymo", "nuscenes"):
        return []
    mounts = "mounted cameras" if flavor.mounted else "a pose for each image"
    rows = f", lidar rows of {flavor.columns} numbers" if layout.has_lidar else ""
    return [f"read as data.log.flavor={flavor.name}: {mounts}, OpenCV's axes{rows}"]
