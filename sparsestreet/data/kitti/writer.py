"""Writes a log as KITTI ships a drive of its raw data, synchronized and rectified."""

import re
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sparsestreet.data.directions import name_losses
from sparsestreet.data.kitti.drive import IMU_FROM_LIDAR, KittiDrive
from sparsestreet.data.kitti.layout import COLOR, GRAY, Drive
from sparsestreet.data.kitti.oxts import oxts_values
from sparsestreet.data.kitti.text import keyed_lines, number_text, stamp_text
from sparsestreet.data.kitti.tracklets import object_type, tracklet_text, tracklets_text
from sparsestreet.data.kitti.velodyne import OWN_CAR
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.losses import mask_losses, moved_boxes, object_losses, point_losses
from sparsestreet.data.pinhole_frames import PinholeFrames, lens_losses
from sparsestreet.data.writer import LogFile, LogWriter
from sparsestreet.geometry.cameras import inverse

_NAME = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}")
_HALF_TURN = 16
"""Nanoseconds. Points of a log are where they were at one instant: a turn this short moves none of them."""
_CALIBRATED = "01-Jan-1970 00:00:00"


@dataclass(frozen=True)
class KittiWriter(LogWriter):
    """One drive of at most four cameras that look the same way, which is all that a rectified rig of KITTI can be.

    Images are PNGs, which have no loss. Masks lie beside the dates, as ``data.log.masks`` takes them.
    """

    drive: int = 1
    """Number of the drive, where the log has no name as KITTI's; its date is that of the first image."""
    masks: bool = True
    """False: none are written."""

    def __post_init__(self) -> None:
        if not 0 <= self.drive <= 9999:
            raise ValueError(f"drive has four digits, got {self.drive}: say 1")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        drive = KittiDrive.of(log)
        layout = self._layout(drive)
        yield from _calibration(drive, layout.folder.parent)
        frames = PinholeFrames(drive.log)
        for view in drive.log.views:
            frame, index = view.indices
            path = layout.image(drive.names[index], frame)
            yield _file(path, partial(frames.image, view.indices, None))
            if self.masks:
                yield from frames.mask_files(view.indices, drive.names[index], path.stem)
        yield from _stamps(drive, layout)
        for frame, motion in {frame: drive.motion(frame) for frame in drive.poses}.items():
            yield _file(layout.oxts(frame), partial(_oxts, drive, frame, motion))
        for place, frame in enumerate(drive.log.sweeps.indices):
            if frame in drive.poses:
                yield _file(layout.sweep(frame), partial(_sweep, drive, place))
        if log.tracks:
            yield _file(layout.tracklets, partial(tracklets_text, list(_tracklets(drive))))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        drive = KittiDrive.of(log)
        found = [*drive.placed.time_losses(), *name_losses(drive.placed, drive.names), *lens_losses(drive.log)]
        if drive.lost:
            named = ", ".join(drive.lost)
            found.append(
                f"{len(drive.lost)} cameras are lost, which do not look as the first one does, or are too many: {named}"
            )
        found += [*_world_losses(drive), *_deviation_losses(drive)]
        found += moved_boxes(drive.placed, lambda _, frame: drive.stamps.get(frame))
        found += [*object_losses(log, object_type), *_name_losses(log), *point_losses(log)]
        found += mask_losses(drive.log) if self.masks else ()
        near, total = drive.near_returns()
        if near:
            what = f"{near} of {total} returns lie within {OWN_CAR} m of where the lidar is put"
            found.append(f"{what}, 0.1 m above the first camera: readers take them for the recording car's")
        return tuple(found)

    def _layout(self, drive: KittiDrive) -> Drive:
        """The paths of the drive, below no folder."""
        date = time.strftime("%Y_%m_%d", time.gmtime(min(drive.stamps.values()) // 1_000_000_000))
        name = drive.log.name if _NAME.fullmatch(drive.log.name) else f"{date}_drive_{self.drive:04d}"
        count = drive.log.num_frames
        return Drive(Path(name[: len(date)], f"{name}_sync"), tuple(drive.names.values()), range(count), count)


def _file(path: Path, content: partial[Iterable[bytes]]) -> LogFile:
    return LogFile(path.as_posix(), content)


def _calibration(drive: KittiDrive, folder: Path) -> Iterator[LogFile]:
    """Rectified frames are those of the first camera. Cameras that the log lacks, which pykitti asks for, are where the
    first one is."""
    numbers = {name: index for index, name in drive.names.items()}
    table: dict[str, object] = {"calib_time": _CALIBRATED}
    for name in sorted((*GRAY, *COLOR)):
        index, number = numbers.get(name, drive.first), name[-2:]
        matrix, size = drive.intrinsics(index)
        place = -drive.rectified_places[index]
        projection = np.column_stack((matrix.numpy(), (matrix @ place).numpy()))
        table |= {f"S_rect_{number}": size, f"R_rect_{number}": np.eye(3), f"P_rect_{number}": projection}
    rigid = {"velo_to_cam": drive.camera_from_lidar, "imu_to_velo": inverse(IMU_FROM_LIDAR)}
    yield _file(folder / "calib_cam_to_cam.txt", partial(_keyed, table))
    for name, transform in rigid.items():
        lines = {"calib_time": _CALIBRATED, "R": transform[:3, :3].numpy(), "T": transform[:3, 3].numpy()}
        yield _file(folder / f"calib_{name}.txt", partial(_keyed, lines))


def _stamps(drive: KittiDrive, layout: Drive) -> Iterator[LogFile]:
    """Images have their own; readers take those of the lidar, if there is any."""
    for index, name in drive.names.items():
        own = [drive.placed.view_stamp(view) for view in drive.log.views if view.indices[1] == index]
        yield _file(layout.image_stamps(name), partial(_lines, own))
    frames = list(drive.stamps.values())
    yield _file(layout.folder / "oxts" / "timestamps.txt", partial(_lines, frames))
    if len(drive.log.sweeps):
        for which, later in (("", 0), ("_start", -_HALF_TURN), ("_end", _HALF_TURN)):
            yield _file(layout.lidar_stamps(which), partial(_lines, [stamp + later for stamp in frames]))


def _oxts(drive: KittiDrive, frame: int, motion: tuple[np.ndarray, np.ndarray]) -> Iterator[bytes]:
    pose, plane = drive.poses[frame].numpy(), drive.plane
    latitude = plane.latitude if frame == min(drive.poses) else plane.latitude_of(float(pose[1, 3]))
    values = oxts_values(latitude, plane.longitude(float(pose[0, 3])), pose, *motion)
    yield f"{number_text(values)}\n".encode()


def _sweep(drive: KittiDrive, place: int) -> Iterator[bytes]:
    """Reflectances are 0: a log has none."""
    (sweep,) = drive.log.sweeps.at([place]).gray()
    rows = np.zeros((len(sweep.points), 4), "<f4")
    rows[:, :3] = drive.points(sweep).numpy()
    yield rows.tobytes()


def _tracklets(drive: KittiDrive) -> Iterator[str]:
    for track in drive.log.tracks:
        frames = [frame for frame in track.frames.tolist() if frame in drive.poses]
        boxes = {frame: drive.lidar_from_object(track, frame).numpy() for frame in frames}
        if boxes:
            yield tracklet_text(object_type(track.class_name), track.size.tolist(), boxes, f"object {track.name}")


def _keyed(table: Mapping[str, object]) -> Iterator[bytes]:
    yield keyed_lines(table)


def _lines(stamps: list[int]) -> Iterator[bytes]:
    yield "".join(f"{stamp_text(stamp)}\n" for stamp in stamps).encode()


def _world_losses(drive: KittiDrive) -> Iterator[str]:
    if drive.shift.any():
        x, y, z = (round(value, 3) for value in drive.shift.tolist())
        yield f"the world is moved by {x}, {y}, {z} m: at its own place no latitude and longitude give it"


def _deviation_losses(drive: KittiDrive) -> Iterator[str]:
    found = drive.deviation()
    if found.nanoseconds:
        away = f"up to {found.nanoseconds / 1e6:.3g} ms from the first one's"
        yield f"own instants of {len(drive.names) - 1} cameras, {away}, are lost to readers, which take the frame's"
    if found.meters > 1e-4 or found.degrees > 1e-2:
        yield (
            f"images are up to {found.meters:.2g} m and {found.degrees:.2g} degrees from where one rig on one car has "
            "them"
        )


def _name_losses(log: DrivingLog) -> Iterator[str]:
    if named := [track.name for place, track in enumerate(log.tracks) if track.name != str(place)]:
        yield f"the names of {len(named)} objects are lost: KITTI numbers them"
