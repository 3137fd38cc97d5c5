"""A log in DriveStudio's processed layout."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.annotations import frame_instances, instances_info, people
from sparsestreet.data.drivestudio.flavors import FLAVORS
from sparsestreet.data.drivestudio.layout import EGO_MASKS, FINE_MASKS, SKY_MASKS, Layout
from sparsestreet.data.drivestudio.losses import losses_of
from sparsestreet.data.encoded import jpeg, mask_png, number_lines, png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks
from sparsestreet.data.stamps import frame_stamps, seconds_lines
from sparsestreet.data.writer import LogFile, LogWriter
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import View


@dataclass(frozen=True)
class DriveStudioWriter(LogWriter):
    """The nuScenes flavor, which has a pose for each image, with ``timestamps_C.txt`` of cameras with own instants.

    Poses are as the log has them, float32 around its origin. Points are in a frame with the world's axes at the first
    camera of their instant, because a log does not know where its lidars are.
    """

    jpeg_quality: int | None = 95
    """1 to 100, at full resolution of color. None: PNGs, under the names in .jpg that the layout has; whoever opens
    images by their content reads them."""

    def __post_init__(self) -> None:
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality lies in 1 to 100, got {self.jpeg_quality}: say 95, or null for PNGs")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        check_cameras(log)
        layout = _layout(log)
        for camera in layout.cameras:
            yield _file(layout.intrinsics(camera), _intrinsics, log, camera)
        yield from _clock(log, layout)
        if log.tracks:
            yield _file(layout.instances, instances_info, log)
            yield _file(layout.frame_instances, frame_instances, log)
        if layout.has_bodies:
            yield _file(layout.bodies, people, log)
        for camera, frame in find_masks(log.frames).ego.items():
            assert frame.ego is not None  # as find_masks says
            yield _file(Path(EGO_MASKS, f"{camera}.png"), mask_png, frame.ego.numpy())
        for place, view in enumerate(log.views):
            frame, camera = view.indices
            yield _file(layout.extrinsics(frame, camera), _pose, world_from_camera(log, view))
            yield _file(layout.image(frame, camera), self._image, log, place)
            yield from _masks(log, place)
            if layout.has_lidar and camera == layout.cameras[-1]:  # its points are in memory for the depth of images
                yield _file(layout.sweep_pose(frame), _pose, _dataset_from_lidar(log, frame))
                yield _file(layout.sweep(frame), _points, log, frame)

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        return losses_of(log)

    def _image(self, log: DrivingLog, place: int) -> bytes:
        pixels = log.frames[place].image.numpy()
        return png(pixels) if self.jpeg_quality is None else jpeg(pixels, self.jpeg_quality)


def check_cameras(log: DrivingLog) -> None:
    """Raises ValueError unless each instant has an image of each camera, whose calibration stays."""
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    there = {view.indices for view in log.views}
    wanted = [(frame, camera) for frame in range(log.num_frames) for camera in range(log.num_cameras)]
    if absent := [pair for pair in wanted if pair not in there]:
        frame, camera = absent[0]
        raise ValueError(
            f"DriveStudio's layout has an image of each camera at each frame, but {len(absent)} of {len(wanted)} are "
            f"absent, the first of camera {names[camera]} at frame {frame}: leave such frames or cameras out "
            "(data.log.first_frame, data.log.last_frame, data.log.cameras)"
        )
    first = {view.camera_index: _numbers_of(view) for view in reversed(log.views)}
    for view in log.views:
        if _numbers_of(view) != first[view.camera_index]:
            frame, camera = view.indices
            raise ValueError(
                f"DriveStudio's layout has one calibration a camera, but that of camera {names[camera]} changes at "
                f"frame {frame}: convert the frames before and behind it apart (data.log.first_frame, .last_frame)"
            )


def world_from_camera(log: DrivingLog, view: View) -> Float64[Tensor, "4 4"]:
    """Pose of a view in the data set's own world."""
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


def _layout(log: DrivingLog) -> Layout:
    """The layout's own names, below no folder."""
    return Layout(
        root=Path(),
        flavor=FLAVORS["nuscenes"],
        frames=range(log.num_frames),
        cameras=tuple(range(log.num_cameras)),
        front=0,
        num_frames_on_disk=log.num_frames,
        has_lidar=len(log.sweeps) > 0,
        has_bodies=any(track.body is not None for track in log.tracks),
    )


def _file(path: Path, make: Callable[..., bytes], *arguments: Any) -> LogFile:
    return LogFile(path.as_posix(), lambda: (make(*arguments),))


def _numbers_of(view: View) -> list[float]:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3."""
    k = view.camera.intrinsics.double()
    lens = view.camera.distortion
    return [*(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))), *([0.0] * 5 if lens is None else lens.tolist())]


def _intrinsics(log: DrivingLog, camera: int) -> bytes:
    return number_lines(_numbers_of(next(view for view in log.views if view.camera_index == camera)))


def _pose(pose: Float64[Tensor, "4 4"]) -> bytes:
    return number_lines(pose.numpy())


def _clock(log: DrivingLog, layout: Layout) -> Iterator[LogFile]:
    stamps = frame_stamps(log)
    if stamps is None:
        return
    yield _file(layout.timestamps, seconds_lines, stamps)
    for camera in layout.cameras:
        own = [view.stamp for view in log.views if view.camera_index == camera and view.stamp is not None]
        if own != list(stamps):
            yield _file(layout.image_timestamps(camera), seconds_lines, own)


def _masks(log: DrivingLog, place: int) -> Iterator[LogFile]:
    kinds = find_masks(log.frames).everywhere
    frame, camera = log.views[place].indices
    name = f"{frame:03d}_{camera}.png"
    moving = [kind for kind in kinds if kind != "sky"]
    if "sky" in kinds:
        yield _file(Path(SKY_MASKS, name), _mask, log, place, ["sky"])
    for kind in moving:
        yield _file(Path(FINE_MASKS, kind, name), _mask, log, place, [kind])
    if moving:
        yield _file(Path(FINE_MASKS, "all", name), _mask, log, place, moving)


def _mask(log: DrivingLog, place: int, kinds: list[str]) -> bytes:
    """Pixels of any of the kinds."""
    frame = log.frames[place]
    return mask_png(torch.stack([getattr(frame, kind) for kind in kinds]).any(0).numpy())


def _dataset_from_lidar(log: DrivingLog, frame: int) -> Float64[Tensor, "4 4"]:
    world_from_lidar = torch.eye(4, dtype=torch.float64)
    world_from_lidar[:3, 3] = _first_position(log, frame)
    return log.dataset_from_world @ world_from_lidar


def _first_position(log: DrivingLog, frame: int) -> Float64[Tensor, "3"]:
    first = next(view for view in log.views if view.frame_index == frame)
    return inverse(first.camera.camera_from_world.double())[:3, 3]


def _points(log: DrivingLog, frame: int) -> bytes:
    """Rows of x, y, z and an intensity, which a log does not have."""
    rows = np.zeros((0, 4), np.float32)
    for sweep in log.sweeps.where(lambda index: index == frame).gray():
        rows = np.zeros((len(sweep.points), 4), np.float32)
        rows[:, :3] = (sweep.points.double() - _first_position(log, frame)).numpy()
    return rows.astype("<f4").tobytes()
