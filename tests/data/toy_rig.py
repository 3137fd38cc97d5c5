"""A second reader: a rig of named cameras, described by one JSON. All but its layout is taken from the common parts."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.images import check_camera_images, image_size, read_image
from sparsestreet.data.lidar import check_points
from sparsestreet.data.log import DrivingLog, absence_notes
from sparsestreet.data.poses import check_extent, check_rigid, dataset_from_world, recentered
from sparsestreet.data.problems import LogError, Problem, attempt, missing_files
from sparsestreet.data.reader import LogFiles, LogReader, chosen_cameras, frame_window
from sparsestreet.data.recording import SceneFolder
from sparsestreet.data.rig import RigCamera, check_lens, rig_camera
from sparsestreet.data.timestamps import LogClock
from sparsestreet.data.tracks import checked_track, timed_tracks, track_in_window
from sparsestreet.types import Frame, Track, View


@dataclass(frozen=True)
class ToyRigReader(LogReader):
    """``log.json`` and the folders ``CAMERA/000.png`` and ``lidar/000.npy``; images have stamps of their own."""

    root: Path
    cameras: Sequence[str] | None = None
    first_frame: int = 0
    last_frame: int = -1
    width: int | None = None

    @property
    def folder(self) -> Path:
        return self.root

    def check(self) -> list[Problem]:
        problems = missing_files([*self._images(), *self._sweeps()])
        placed = []
        for name in self._names():
            camera, size = self._camera(name), image_size(self._image(name, self._frames()[0]))
            attempt(problems, partial(check_lens, self._table, camera["k"], camera["lens"], size))
            for frame in self._frames():
                pose = camera["poses"][frame]
                attempt(problems, partial(check_rigid, pose, self._table, f"the pose of {name} at frame {frame}"))
                placed.append((self._table, pose[:3, 3]))
            problems += check_camera_images(
                name, [self._image(name, frame) for frame in self._frames()], (), decode=True
            )
        attempt(problems, self._tracks)
        for index in range(len(self._frames())):
            attempt(problems, partial(self._points, index))
        return [*problems, *check_extent(placed)]

    def read(self) -> DrivingLog:
        if problems := self.check():
            raise LogError(problems)
        stamps, frames, origin = self._log["stamps"], self._frames(), self._origin()
        images = [self._camera(name)["stamps"][frame] for name in self._names() for frame in frames]
        clock = LogClock(len(frames), tuple(stamps[frame] for frame in frames), images)
        rig = [self._mounted(name, index) for index, name in enumerate(self._names())]
        views = [
            clock.view(camera.at(recentered(one["poses"][frame], origin)), index, camera.index, one["stamps"][frame])
            for index, frame in enumerate(frames)
            for camera, one in ((camera, self._camera(camera.name)) for camera in rig)
        ]
        tracks = [track_in_window(track, frames, origin) for track in self._tracks()]
        tracks = timed_tracks([track for track in tracks if track is not None], clock, views)
        folder = SceneFolder(
            views, partial(self._frame, rig), self._points, clock=clock, cache_bytes=0, check=self.check, tracks=tracks
        )
        absent = absence_notes(sky=False, human=False, vehicle=False, lidar=True, boxes=True, clock=True)
        return DrivingLog(
            self.root.name,
            folder.frames,
            folder.sweeps,
            tracks,
            len(frames),
            len(rig),
            dataset_from_world(origin),
            (*absent, *(camera.note for camera in rig if camera.note is not None)),
        )

    def files(self) -> LogFiles:
        return LogFiles(described=[self._table], recorded=[*self._images(), *self._sweeps()])

    @property
    def _table(self) -> Path:
        return self.root / "log.json"

    @property
    def _log(self) -> dict[str, Any]:
        return json.loads(self._table.read_text())

    def _frames(self) -> range:
        return frame_window(len(self._log["stamps"]), self.first_frame, self.last_frame, self.root)

    def _names(self) -> tuple[str, ...]:
        return chosen_cameras(list(self._log["cameras"]), self.cameras, self.root)

    def _camera(self, name: str) -> dict[str, Any]:
        camera = self._log["cameras"][name]
        arrays = {key: torch.tensor(camera[key], dtype=torch.float64) for key in ("k", "lens", "poses")}
        return camera | arrays

    def _mounted(self, name: str, index: int) -> RigCamera[str]:
        camera = self._camera(name)
        return rig_camera(
            name,
            index,
            intrinsics=camera["k"],
            distortion=camera["lens"],
            recorded_size=image_size(self._image(name, 0)),
            width=self.width,
        )

    def _origin(self) -> Tensor:
        return self._camera(self._names()[0])["poses"][self._frames()[0]][:3, 3]

    def _tracks(self) -> list[Track]:
        count = len(self._log["stamps"])
        return [
            checked_track(
                name,
                box["class"],
                *(np.array(box[key], float) for key in ("frames", "poses", "sizes")),
                path=self._table,
                num_frames=count,
            )
            for name, box in self._log["boxes"].items()
        ]

    def _frame(self, rig: Sequence[RigCamera[str]], view: View) -> Frame:
        index, number = view.indices
        camera = rig[number]
        return Frame.of(view, image=read_image(self._image(camera.name, self._frames()[index]), camera.size))

    def _points(self, index: int) -> Float[Tensor, "n 3"]:
        """The lidar sits where the first camera does, with the axes of the world."""
        frame = self._frames()[index]
        points = torch.from_numpy(np.load(self._sweep(frame)))
        check_points(points, self._sweep(frame))
        return (points + self._camera(next(iter(self._log["cameras"])))["poses"][frame][:3, 3] - self._origin()).float()

    def _images(self) -> list[Path]:
        return [self._image(name, frame) for name in self._names() for frame in self._frames()]

    def _sweeps(self) -> list[Path]:
        return [self._sweep(frame) for frame in self._frames()]

    def _image(self, name: str, frame: int) -> Path:
        return self.root / name / f"{frame:03d}.png"

    def _sweep(self, frame: int) -> Path:
        return self.root / "lidar" / f"{frame:03d}.npy"
