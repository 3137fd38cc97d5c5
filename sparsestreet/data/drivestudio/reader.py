"""From a folder in DriveStudio's processed layout to a DrivingLog."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import with_bodies
from sparsestreet.data.drivestudio.check import check_layout
from sparsestreet.data.drivestudio.instances import read_instances, window
from sparsestreet.data.drivestudio.layout import Layout, find_layout
from sparsestreet.data.drivestudio.poses import world_origin
from sparsestreet.data.drivestudio.source import Source, read_mount
from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError, Problem
from sparsestreet.data.reader import LogReader
from sparsestreet.types import Track

_ABSENT = {
    "sky": "no sky masks: nothing but the images tells sky from scene, and there is no sky term in the loss",
    "human": "no human masks: there are no metrics of human pixels",
    "vehicle": "no vehicle masks: there are no metrics of vehicle pixels",
    "lidar": "no lidar: Gaussians start from points in images and random ones, and there is no depth term in the loss",
    "boxes": "no boxes: nothing is modeled as moving, whatever moves becomes part of the background",
}


@dataclass(frozen=True)
class DriveStudioReader(LogReader):
    """Frames first_frame .. last_frame (included) of some cameras, of the folder of one scene.

    Both flavors are recognized by their files. The world keeps the data set's axes and is shifted, in float64, so
    that the vehicle (Waymo) or the front camera (nuScenes) starts at the origin. Frames are counted from the window's
    start, cameras by their place in ``cameras``. Time is frame / (frames - 1), 0 in a log of one frame.
    """

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
    min_lens_shift: float | None = 0.5
    """Pixels; a lens that moves some pixel of the image, as it is read, by at least so much is simulated; 0: every lens
    that is one, None: none. The log's notes say which."""
    cache_mb: int = 512
    """Decoded frames kept in memory, MB (1e6 bytes); a frame takes about 10 bytes a pixel."""

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
        origin = world_origin(layout)
        tracks, people = _read_tracks(layout, origin)
        mounts = [
            read_mount(layout, index, number, self.width, self.min_lens_shift)
            for index, number in enumerate(layout.cameras)
        ]
        source = Source(layout, mounts, origin, 1_000_000 * self.cache_mb, lambda: check_layout(layout, contents=True))
        dataset_from_world = torch.eye(4, dtype=torch.float64)
        dataset_from_world[:3, 3] = origin
        return DrivingLog(
            name=layout.root.resolve().name,
            frames=Frames(source.views, source.frame),
            sweeps=Sweeps(range(len(layout.frames)) if layout.has_lidar else (), source.sweep, source.gray_sweep),
            tracks=tracks,
            num_frames=len(layout.frames),
            num_cameras=len(mounts),
            dataset_from_world=dataset_from_world,
            notes=(*_notes(layout), *(mount.note for mount in mounts if mount.note is not None), *people),
        )

    def _layout(self) -> Layout:
        return find_layout(
            self.folder,
            cameras=self.cameras,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
            lidar=self.lidar,
            bodies=self.bodies,
        )


def _read_tracks(layout: Layout, origin: Float64[Tensor, "3"]) -> tuple[tuple[Track, ...], tuple[str, ...]]:
    """The objects in the window, and what has to be said about their body poses."""
    if not layout.has_instances:
        return (), ()
    tracks, notes = with_bodies(read_instances(layout), layout)
    windows = [window(track, layout.frames, origin) for track in tracks]
    return tuple(track for track in windows if track is not None), notes


def _notes(layout: Layout) -> tuple[str, ...]:
    present = {kind: layout.mask_folder(kind) is not None for kind in ("sky", "human", "vehicle")}
    present |= {"lidar": layout.has_lidar, "boxes": layout.has_instances}
    return tuple(sentence for kind, sentence in _ABSENT.items() if not present[kind])
