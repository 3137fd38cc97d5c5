"""A log in DriveStudio's processed layout."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.convert import LogFile, LogWriter
from sparsestreet.data.drivestudio.annotations import frame_instances, instances_info, people, written_tracks
from sparsestreet.data.drivestudio.layout import EGO_MASKS, FINE_MASKS, SKY_MASKS, Layout
from sparsestreet.data.drivestudio.losses import losses_of, unread_by_drivestudio
from sparsestreet.data.drivestudio.placement import CAMERAS, Placement, WrittenFlavor, placed
from sparsestreet.data.encoded import jpeg, mask_png, number_lines, png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks
from sparsestreet.data.poses import AHEAD_FROM_OPENCV
from sparsestreet.data.stamps import frame_stamps, seconds_lines
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import View

_FLOW_CLASS = 9
"""Column of a row of Waymo's."""


@dataclass(frozen=True)
class DriveStudioWriter(LogWriter):
    """What DriveStudio's own loaders and ours read: its flavor of Waymo, or that of nuScenes.

    Waymo's has rigid cameras on a vehicle. nuScenes' has a pose for each image, and ``timestamps_C.txt`` of cameras
    with own instants. Poses are as the log has them, float32 around its origin.
    """

    jpeg_quality: int | None = 95
    """1 to 100, at full resolution of color. None: PNGs, under the names in .jpg that the layout has; whoever opens
    images by their content reads them."""
    flavor: WrittenFlavor = "auto"
    """"auto": waymo for Waymo's logs (``placement.placed``), nuscenes for others."""

    def __post_init__(self) -> None:
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality lies in 1 to 100, got {self.jpeg_quality}: say 95, or null for PNGs")
        if self.flavor not in get_args(WrittenFlavor):
            raise ValueError(f"flavor must be one of {', '.join(get_args(WrittenFlavor))}, got {self.flavor!r}")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        check_cameras(log)
        where = placed(log, self.flavor)
        layout = _layout(log, where)
        for index, camera in enumerate(where.cameras):
            yield _file(layout.intrinsics(camera), _intrinsics, log, index)
        yield from _clock(log, layout, where)
        if written_tracks(log, where.flavor.name):
            yield _file(layout.instances, instances_info, log, where.flavor.name)
            yield _file(layout.frame_instances, frame_instances, log, where.flavor.name)
        if layout.has_bodies:
            yield _file(layout.bodies, people, log, where)
        for index, frame in find_masks(log.frames).ego.items():
            assert frame.ego is not None  # as find_masks says
            yield _file(Path(EGO_MASKS, f"{where.cameras[index]}.png"), mask_png, frame.ego.numpy())
        yield from _poses(log, layout, where)
        for place, view in enumerate(log.views):
            frame, index = view.indices
            camera = where.cameras[index]
            yield _file(layout.image(frame, camera), self._image, log, place)
            yield from _masks(log, place, camera)
            if layout.has_lidar and index == log.num_cameras - 1:  # its points are in memory for the depth of images
                yield _file(layout.sweep(frame), _points, log, where, frame)

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        pixels = () if self.jpeg_quality is None else (f"images become JPEG of quality {self.jpeg_quality}",)
        return (*losses_of(log, placed(log, self.flavor)), *pixels)

    def notes(self, log: DrivingLog) -> tuple[str, ...]:
        where = placed(log, self.flavor)
        what = "a pose for each image" if where.mounts is None else "cameras that are rigid on a vehicle"
        chosen = f"the flavor is {where.flavor.name}, which has {what}; flavor=... names another"
        return (*([chosen] if self.flavor == "auto" else []), *unread_by_drivestudio(log, where, stand_ins(log, where)))

    def _image(self, log: DrivingLog, place: int) -> bytes:
        pixels = log.frames[place].image.numpy()
        return png(pixels) if self.jpeg_quality is None else jpeg(pixels, self.jpeg_quality)


def stand_ins(log: DrivingLog, where: Placement) -> tuple[int, ...]:
    """Cameras that the log lacks, and whose poses DriveStudio's loaders read nonetheless.

    Where there are bodies they read those of all cameras of their data set, and of nuScenes those of camera 0 always.
    """
    bodies = any(track.body is not None for track in written_tracks(log, where.flavor.name))
    read = range(len(CAMERAS[where.flavor.name])) if bodies else range(where.mounts is None)
    return tuple(camera for camera in read if camera not in where.cameras)


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


def _layout(log: DrivingLog, where: Placement) -> Layout:
    """The layout's own names, below no folder."""
    return Layout(
        root=Path(),
        flavor=where.flavor,
        frames=range(log.num_frames),
        cameras=where.cameras,
        front=min(where.cameras),
        num_frames_on_disk=log.num_frames,
        has_lidar=len(log.sweeps) > 0,
        has_bodies=any(track.body is not None for track in written_tracks(log, where.flavor.name)),
    )


def _poses(log: DrivingLog, layout: Layout, where: Placement) -> Iterator[LogFile]:
    """Of cameras, those that the log lacks as its first one, and of vehicle or lidar."""
    numbers = [*enumerate(where.cameras), *((0, camera) for camera in stand_ins(log, where))]
    if where.mounts is not None:
        for index, camera in numbers:
            yield _file(layout.extrinsics(0, camera), _pose, where.mounts[index] @ inverse(AHEAD_FROM_OPENCV))
    else:
        place = {view.indices: place for place, view in enumerate(log.views)}
        for frame in range(log.num_frames):
            for index, camera in numbers:
                yield _file(layout.extrinsics(frame, camera), _pose, where.world_from_camera[place[frame, index]])
    for frame in range(log.num_frames if layout.has_lidar or where.mounts is not None else 0):
        yield _file(layout.sweep_pose(frame), _pose, where.world_from_sweep[frame])


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


def _clock(log: DrivingLog, layout: Layout, where: Placement) -> Iterator[LogFile]:
    """Stamps of frames, and of images where they have poses of their own."""
    stamps = frame_stamps(log)
    if stamps is None:
        return
    yield _file(layout.timestamps, seconds_lines, stamps)
    for index, camera in enumerate(where.cameras if where.mounts is None else ()):
        own = [view.stamp for view in log.views if view.camera_index == index and view.stamp is not None]
        if own != list(stamps):
            yield _file(layout.image_timestamps(camera), seconds_lines, own)


def _masks(log: DrivingLog, place: int, camera: int) -> Iterator[LogFile]:
    kinds = find_masks(log.frames).everywhere
    name = f"{log.views[place].indices[0]:03d}_{camera}.png"
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


def _points(log: DrivingLog, where: Placement, frame: int) -> bytes:
    """Rows of the flavor. What a log does not have is 0, and the class of flow -1, none.

    All rays of Waymo's flavor start at the first camera, and are those of the lidar TOP, which alone DriveStudio reads.
    """
    rows = np.zeros((0, where.flavor.columns), np.float32)
    for sweep in log.sweeps.where(lambda index: index == frame).gray():
        rows = np.zeros((len(sweep.points), where.flavor.columns), np.float32)
        sweep_from_world = inverse(where.world_from_sweep[frame]) @ log.dataset_from_world
        first = where.flavor.x_column
        rows[:, first : first + 3] = transform_points(sweep_from_world, sweep.points.double()).numpy()
        if where.mounts is not None:
            rows[:, :3], rows[:, _FLOW_CLASS] = where.mounts[0, :3, 3].numpy(), -1
    return rows.astype("<f4").tobytes()
