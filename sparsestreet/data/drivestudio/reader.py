"""From a folder in DriveStudio's processed layout to a DrivingLog."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import with_bodies
from sparsestreet.data.drivestudio.check import check_layout
from sparsestreet.data.drivestudio.files import complete, hashed_files
from sparsestreet.data.drivestudio.flavors import FlavorName
from sparsestreet.data.drivestudio.frames import pixel_notes, read_frame, read_rig, read_views
from sparsestreet.data.drivestudio.instances import read_instances
from sparsestreet.data.drivestudio.layout import Layout, find_layout
from sparsestreet.data.drivestudio.poses import first_pose, read_clock, read_vehicle
from sparsestreet.data.drivestudio.sweeps import read_points, sweep_notes
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.frame_cache import CacheSize, cache_bytes
from sparsestreet.data.log import DrivingLog, SceneExtent, VehiclePath
from sparsestreet.data.marks import Marks
from sparsestreet.data.notes import absence_notes
from sparsestreet.data.poses import dataset_from_world, recentered
from sparsestreet.data.problems import LogError, Missing, Problem, check_missing, missing_notes
from sparsestreet.data.reader import LogReader
from sparsestreet.data.scene_folder import SceneFolder
from sparsestreet.data.tracks import timed_tracks, track_in_window
from sparsestreet.types import Track


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

    marks = Marks(("images/[0-9][0-9][0-9]_[0-9].jpg", "extrinsics/*.txt"))

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
        if self.extent not in get_args(SceneExtent):
            raise ValueError(f"extent must be one of {', '.join(get_args(SceneExtent))}, got {self.extent!r}")
        if self.lidar_ahead is not None and not (
            len(self.lidar_ahead) == 2 and self.lidar_ahead[0] < self.lidar_ahead[1]
        ):
            raise ValueError(f"lidar_ahead needs a least and a larger distance, got {self.lidar_ahead}: say [-2, 80]")

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
            carried_without=folder.holding_out,
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
