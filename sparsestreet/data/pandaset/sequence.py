"""A log as a sequence of PandaSet: instants of the front camera, and everything in the world then."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.directions import names_by_direction
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes
from sparsestreet.data.pandaset.layout import CAMERA_FROM_LIDAR, CAMERAS, FRONT, OWN_CAR
from sparsestreet.data.pandaset.tables import PER_SECOND
from sparsestreet.data.pinhole_frames import check_every_image, rig_of
from sparsestreet.data.placed import PlacedLog, quaternion
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Sweep, Track


@dataclass(frozen=True)
class WrittenSequence:
    """A log whose frames are when the front camera fires."""

    placed: PlacedLog
    names: dict[int, str]
    """Index of a camera -> its folder."""

    @staticmethod
    def of(log: DrivingLog) -> "WrittenSequence":
        """Raises ValueError for a log that lacks an image at some frame, or has no camera ahead."""
        check_every_image(log, "PandaSet")
        placed = PlacedLog(log, LogTimes.of(log))
        names = names_by_direction(placed, CAMERAS, "camera_")
        if FRONT not in names.values():
            raise ValueError(f"PandaSet needs its {FRONT}, the log has {', '.join(names.values())}: read it too")
        return WrittenSequence(placed, names)

    @cached_property
    def front(self) -> list[Float64[Tensor, "4 4"]]:
        """world_from_camera of each frame."""
        return self._poses(next(index for index, name in self.names.items() if name == FRONT))

    @cached_property
    def stamps(self) -> list[int]:
        return self._stamps(next(index for index, name in self.names.items() if name == FRONT))

    def camera_tables(self, index: int) -> dict[str, str]:
        """The files of a camera beside its images."""
        (fx, _, cx), (_, fy, cy), _ = rig_of(self.placed.log)[index].intrinsics.double().tolist()
        numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        poses = json.dumps([_entry(pose) for pose in self._poses(index)])
        return {"intrinsics": json.dumps(numbers), "poses": poses, "timestamps": _seconds(self._stamps(index))}

    def lidar_tables(self) -> dict[str, str]:
        """PandaSet's own kit asks for both."""
        poses = json.dumps([_entry(pose @ CAMERA_FROM_LIDAR) for pose in self.front])
        return {"poses": poses, "timestamps": _seconds(self.stamps)}

    def sweep(self, frame: int) -> Sweep | None:
        return next(iter(self.placed.log.sweeps.where(lambda index: index == frame).gray()), None)

    def points(self, sweep: Sweep) -> Float64[Tensor, "n 3"]:
        """In the world, where the street is at the frame's stamp."""
        return self.placed.points(sweep, self.stamps[sweep.index])

    def boxes(self, frame: int) -> Iterator[tuple[Track, Float64[Tensor, "4 4"]]]:
        """At the frame's stamp."""
        for track in self.placed.log.tracks:
            if frame in track.frames.tolist():
                yield track, self.placed.box(track, frame, self.stamps[frame])

    def largest_tilt(self) -> float:
        """Degrees between upright and a box's own upright."""
        cosines = [float(pose[2, 2]) for frame in range(len(self.stamps)) for _, pose in self.boxes(frame)]
        return math.degrees(math.acos(min(1.0, *cosines))) if cosines else 0.0

    def near_returns(self) -> tuple[int, int]:
        """Returns that readers take for the recording car's, and all. Reads all."""
        near = total = 0
        for sweep in self.placed.log.sweeps.gray():
            local = transform_points(inverse(self.front[sweep.index] @ CAMERA_FROM_LIDAR), self.points(sweep))
            near += int((local.abs() < torch.tensor(OWN_CAR)).all(-1).sum())
            total += len(local)
        return near, total

    def _poses(self, index: int) -> list[Float64[Tensor, "4 4"]]:
        return [self.placed.world_from_camera(view) for view in self.placed.log.views if view.indices[1] == index]

    def _stamps(self, index: int) -> list[int]:
        return [self.placed.view_stamp(view) for view in self.placed.log.views if view.indices[1] == index]


def _entry(pose: Float64[Tensor, "4 4"]) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "heading": dict(zip("wxyz", quaternion(pose), strict=True)),
    }


def _seconds(stamps: list[int]) -> str:
    """A list with all nanoseconds, of which a double would lose some."""
    texts = [f"{'-' if stamp < 0 else ''}{abs(stamp) // PER_SECOND}.{abs(stamp) % PER_SECOND:09d}" for stamp in stamps]
    return f"[{', '.join(texts)}]"
