"""From ``rig.json`` and the files that it names to a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.images import check_camera_images, check_image_sizes, read_mask
from sparsestreet.data.lidar import check_points, empty_notes, returned, unit_intensities
from sparsestreet.data.ply import read_ply
from sparsestreet.data.poses import PosePath, check_extent, untwisted
from sparsestreet.data.problems import (
    LogError,
    Missing,
    Problem,
    check_missing,
    fault,
    missing_files,
    missing_notes,
)
from sparsestreet.data.reader import FolderSignature, LogFiles, chosen_cameras, frame_window
from sparsestreet.data.recorded_images import Pixels, RecordedImage
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera, check_lens_camera, lens_camera
from sparsestreet.data.rig_json.table import (
    CameraEntry,
    FrameEntry,
    ImageEntry,
    LidarEntry,
    RigTable,
    read_table,
    with_files,
)
from sparsestreet.geometry.cameras import transform_points
from sparsestreet.types import Shutter

_INTENSITY = "intensity"
_BIN = ("x", "y", "z", _INTENSITY)
_LONGEST_SWEEP = 1.0
"""Seconds around its stamp in which a point may have been measured."""


def read_sweep(
    path: Path, frame: FrameEntry, lidar: LidarEntry, drive: PosePath | None, reference: Float64[Tensor, "3"]
) -> Float64[Tensor, "n 3"]:
    """Points in the world.

    Args:
        path: the file.
        frame: whose sweep it is.
        lidar: how it is written.
        drive: world_from_vehicle over time; None: without a clock.
        reference: a place near the lidar, in the world.

    Raises LogError for a file that is missing or holds anything else.
    """
    points, times, _ = _returns(path, lidar, reference)
    if (mount := lidar.vehicle_from_lidar) is None:
        return points
    points = transform_points(mount, points)
    stamp = frame.stamp if frame.sweep_stamp is None else frame.sweep_stamp
    if stamp is None or drive is None:
        assert frame.world_from_vehicle is not None  # the reader has looked
        return transform_points(frame.world_from_vehicle, points)
    try:
        if times is None:
            return transform_points(drive.at(torch.tensor([stamp]))[0], points)
        return untwisted(points, stamp + (1e9 * times).round().long(), drive)
    except ValueError as error:
        raise fault(path, str(error), "leave out what was measured outside of the drive") from error


def read_intensities(path: Path, lidar: LidarEntry, reference: Float64[Tensor, "3"]) -> Float[Tensor, " n"]:
    """Those of the points of ``read_sweep``, of which each has one."""
    _, _, intensities = _returns(path, lidar, reference)
    assert intensities is not None  # the reader has looked
    return intensities


def has_intensities(path: Path, columns: tuple[str, ...] | None) -> bool:
    """Whether the rows of a sweep have a column of that name."""
    return path.suffix != ".ply" and _INTENSITY in (columns or (_BIN if path.suffix == ".bin" else ()))


def _returns(
    path: Path, lidar: LidarEntry, reference: Float64[Tensor, "3"]
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, " n"] | None, Float[Tensor, " n"] | None]:
    """The points that are returns from the street, as they are written, with times and intensities."""
    rows = read_rows(path, lidar.columns)
    # Who writes the world's points moves a driver's zeros to the sensor, or leaves them.
    some = returned(rows[0])
    mount = lidar.vehicle_from_lidar
    check_points((rows[0] - reference if mount is None else rows[0])[some], path)
    away = rows[0] - (reference if mount is None else 0.0)
    some &= (away.norm(dim=-1) >= lidar.nearest) & returned(away)
    points, times, intensities = (None if one is None else one[some] for one in rows)
    assert points is not None
    return points, times, intensities


def read_rows(
    path: Path, columns: tuple[str, ...] | None
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, " n"] | None, Float[Tensor, " n"] | None]:
    """Points as they are written, their seconds behind the stamp of the sweep and their intensities, where ``columns``
    have a time or an intensity."""
    if path.suffix == ".ply":
        return read_ply(path)[0], None, None
    if path.suffix not in (".bin", ".npy"):
        raise fault(path, f"points of the ending {path.suffix!r} are not read", "write .bin, .npy or .ply")
    rows = _binary(path, columns or _BIN) if path.suffix == ".bin" else _array(path, columns)
    names = columns or (_BIN if path.suffix == ".bin" else _BIN[:3])
    intensities = unit_intensities(rows[:, names.index(_INTENSITY)], None) if _INTENSITY in names else None
    points = np.stack([rows[:, names.index(axis)] for axis in "xyz"], 1).astype(np.float64)
    if "time" not in names:
        return torch.from_numpy(points), None, intensities
    times = torch.from_numpy(rows[:, names.index("time")].astype(np.float64))
    if not (times.abs() <= _LONGEST_SWEEP).all():
        message = f"times must lie within {_LONGEST_SWEEP:g} s of the sweep's stamp"
        raise fault(path, message, "write seconds behind the stamp")
    return torch.from_numpy(points), times, intensities


def _binary(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or leave out the frame's lidar")
    if path.stat().st_size % (4 * len(columns)):
        message = f"{path.stat().st_size} bytes are no whole number of rows of {len(columns)} float32"
        raise fault(path, message, f"write rows of {', '.join(columns)}, or name the columns in lidar.columns")
    check_regular(path)
    return np.fromfile(path, dtype="<f4").reshape(-1, len(columns))


def _array(path: Path, columns: tuple[str, ...] | None) -> np.ndarray:
    """Mapped, so that a header cannot ask for memory that the file does not fill."""
    try:
        rows = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy's parser of headers raises whatever Python's own does
        raise fault(path, f"the file is no array ({str(error)[:80]})", "write it by numpy.save") from error
    wanted = "at least 3" if columns is None else str(len(columns))
    fits = rows.ndim == 2 and (rows.shape[1] >= 3 if columns is None else rows.shape[1] == len(columns))
    if not fits or rows.dtype.kind not in "fiu":
        message = f"the array is {rows.dtype} of {rows.shape}, not numbers in rows of {wanted}"
        raise fault(path, message, "write a row a point: x, y, z and whatever lidar.columns names")
    return rows


_PER_SECOND = 1e9


@dataclass(frozen=True)
class Part:
    """The chosen cameras and frames of a table."""

    table: RigTable
    cameras: Sequence[str]
    places: Sequence[int]
    """Of the frames in the table: those of the window with an image of these cameras."""

    @property
    def frames(self) -> list[FrameEntry]:
        return [self.table.frames[place] for place in self.places]

    @property
    def stamps(self) -> tuple[int, ...] | None:
        """None: there is no clock."""
        return tuple(frame.stamp for frame in self.frames if frame.stamp is not None) or None

    @property
    def vehicle(self) -> PosePath | None:
        """At the frames of the window; None: without a clock, or without poses."""
        return _drive(self.frames)

    def shots(self) -> list[RecordedImage]:
        drive = _drive(self.table.frames)
        return [
            _shot(self.table, drive, entry, frame, index, name)
            for frame, entry in enumerate(self.frames)
            for index, name in enumerate(self.cameras)
            if name in entry.images
        ]

    def sweeps(self, shots: Sequence[RecordedImage]) -> dict[int, LidarSweep] | None:
        """Of the frames that have one; None: no frame of the table has."""
        if not any(frame.sweep for frame in self.table.frames):
            return None
        drive = _drive(self.table.frames)
        near = {shot.frame: shot.world_from_camera[:3, 3] for shot in reversed(shots)}
        sweeps = {}
        for index, frame in enumerate(self.frames):
            if frame.sweep is not None:
                stamp = frame.stamp if frame.sweep_stamp is None else frame.sweep_stamp
                reference = near[index] if frame.world_from_vehicle is None else frame.world_from_vehicle[:3, 3]
                read = partial(read_sweep, frame.sweep, frame, self.table.lidar, drive, reference)
                stood = _stood(frame, self.table.lidar.vehicle_from_lidar, stamp, drive)
                has = has_intensities(frame.sweep, self.table.lidar.columns)
                intensities = partial(read_intensities, frame.sweep, self.table.lidar, reference) if has else None
                sweeps[index] = LidarSweep(read, stamp, stood, intensities)
        return sweeps

    def boxes(self) -> list[Boxes] | None:
        """Objects with a box in these frames, in their count."""
        if self.table.boxes is None:
            return None
        index = {place: index for index, place in enumerate(self.places)}
        found = []
        for box in self.table.boxes:
            rows = [row for row, place in enumerate(box.frames.tolist()) if place in index]
            if rows:
                frames = np.array([index[place] for place in box.frames[rows].tolist()])
                stamps = None if box.stamps is None else tuple(box.stamps[row] for row in rows)
                found.append(replace(box, frames=frames, poses=box.poses[rows], sizes=box.sizes[rows], stamps=stamps))
        return found


def _shot(
    table: RigTable, drive: PosePath | None, entry: FrameEntry, frame: int, index: int, name: str
) -> RecordedImage:
    image, mount = entry.images[name], table.cameras[name].vehicle_from_camera
    stamp = entry.stamp if image.stamp is None else image.stamp
    pose = image.world_from_camera
    if pose is None:
        if mount is None or entry.world_from_vehicle is None:
            raise image.where.fault("has no pose", "write world_from_camera")  # read_table has looked
        pose = entry.world_from_vehicle @ mount
        if stamp is not None and stamp != entry.stamp and drive is not None:
            try:
                pose = drive.at(torch.tensor([stamp]))[0] @ mount
            except ValueError as error:
                remedy = "give the image its own world_from_camera, or the frames poses around it"
                raise image.where.fault(f"has no pose: {error}", remedy) from error
    shutter = _shutter(table.cameras[name], drive, image, stamp)
    exposure = table.cameras[name].exposure
    return RecordedImage(frame, index, pose, image.path, image.path.stem, stamp, shutter, exposure)


def _shutter(camera: CameraEntry, drive: PosePath | None, image: ImageEntry, stamp: int | None) -> Shutter | None:
    """The camera's motion on the vehicle's path while the image is read out; None: it is exposed at once."""
    if not camera.readout:
        return None
    if drive is None or stamp is None or camera.vehicle_from_camera is None:
        remedy = "write stamps and world_from_vehicle of the frames and the camera's mount, or leave out its shutter"
        raise image.where.fault("has a shutter, but nothing tells how the camera moves", remedy)
    path = replace(drive, poses=drive.poses @ camera.vehicle_from_camera)
    try:
        return Shutter(*path.motion_during(stamp, camera.readout), camera.side, camera.readout / _PER_SECOND)
    except ValueError as error:
        remedy = "give the frames poses around it, or leave the image out"
        raise image.where.fault(f"is read out where no pose is known: {error}", remedy) from error


def _drive(frames: Sequence[FrameEntry]) -> PosePath | None:
    """Where the vehicle is over time, and a frame's step beyond; None: without a clock, or without poses."""
    known = [
        (frame.stamp, frame.world_from_vehicle)
        for frame in frames
        if frame.stamp is not None and frame.world_from_vehicle is not None
    ]
    if not known:
        return None
    stamps = [stamp for stamp, _ in known]
    step = (stamps[-1] - stamps[0]) // max(len(stamps) - 1, 1)
    return PosePath(torch.tensor(stamps), torch.stack([pose for _, pose in known]), max_extrapolation=step)


def _stood(
    frame: FrameEntry, mount: Float64[Tensor, "4 4"] | None, stamp: int | None, drive: PosePath | None
) -> Float64[Tensor, "3"] | None:
    """Where the lidar was at the stamp of its sweep; None where points are the world's, or the drive does not reach."""
    vehicle = frame.world_from_vehicle
    if stamp is not None and drive is not None:
        try:
            vehicle = drive.at(torch.tensor([stamp]))[0]
        except ValueError:  # said when the sweep is read
            return None
    return None if mount is None or vehicle is None else (vehicle @ mount)[:3, 3]


def _read_masks(table: RigTable, pixels: Pixels, shot: RecordedImage) -> dict[str, Bool[Tensor, "h w"]]:
    """Those that the log and the user have; what either excludes is excluded."""
    camera, masks = pixels.rig[shot.camera], pixels.masks(shot)
    path = table.cameras[camera.name].ego_mask
    if path is None:
        return masks
    ego = read_mask(path, camera.size, sky=False, undistortion=camera.undistortion)
    return masks | {"ego": masks["ego"] | ego if "ego" in masks else ego}


@dataclass(frozen=True, kw_only=True)
class RigJsonReader(RecordedReader):
    """A folder with a ``rig.json`` that somebody wrote by hand (docs/datasets/rig_json.md)."""

    marks = FolderSignature(("rig.json",))

    pinhole_fov: float | None = None
    """Degrees that the pinhole of a lens that is not simulated sees from left to right; None: its resolution is that of
    the lens's center."""
    missing: Missing = "error"
    """skip: images that are listed and have no file are left out with a note, as are frames without any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_missing(self.missing)

    def recording(self) -> Recording:
        part = self._part()
        rig, shots = [self._camera(part, index) for index in range(len(part.cameras))], part.shots()
        if problems := self._problems(part, shots):
            raise LogError(problems)
        cameras = [part.table.cameras[name] for name in part.cameras]
        pixels = Pixels(rig, [camera.size for camera in cameras], self.given, said="rig.json says")
        return Recording(
            name=self.folder.resolve().name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=partial(_read_masks, part.table, pixels),
            mask_kinds=self.given.beside(["ego"] if any(one.ego_mask for one in cameras) else ()),
            frame_stamps=part.stamps,
            sweeps=part.sweeps(shots) if self.lidar else None,
            boxes=part.boxes(),
            vehicle=part.vehicle,
            notes=self._notes(part),
        )

    def files(self) -> LogFiles:
        part = self._part()
        return LogFiles([part.table.path], _recorded(part))

    def _part(self) -> Part:
        table = read_table(self.folder / "rig.json")
        table = with_files(table) if self.missing == "skip" else table
        window = frame_window(len(table.frames), self.first_frame, self.last_frame, self.folder)
        names = chosen_cameras(list(table.cameras), self.cameras, self.folder)
        places = [place for place in window if not table.frames[place].images.keys().isdisjoint(names)]
        if not places:
            frames = f"frames {window.start} to {window.stop - 1}"
            raise ValueError(f"{frames} have no image of {', '.join(names)}: {self.folder}")
        return Part(table, names, places)

    def _notes(self, part: Part) -> tuple[str, ...]:
        window = frame_window(len(part.table.frames), self.first_frame, self.last_frame, self.folder)
        left_out = len(window) - len(part.places)
        absent = missing_notes(part.table.absent, part.table.listed)
        sweeps = [frame.sweep for frame in part.frames if frame.sweep is not None] if self.lidar else []
        empty = empty_notes(lambda path: read_rows(path, part.table.lidar.columns)[0], sweeps)
        homeless = [f"{left_out} of {len(window)} frames have no image and are left out"] if left_out else []
        return (*absent, *homeless, *empty)

    def _camera(self, part: Part, index: int) -> RigCamera[str]:
        name = part.cameras[index]
        entry = part.table.cameras[name]
        check_lens_camera(part.table.path, entry.lens, entry.size)
        return lens_camera(
            name,
            index,
            lens=entry.lens,
            recorded_size=entry.size,
            width=self.width,
            pinhole_fov=self.pinhole_fov,
            undistort=self.undistort,
        )

    def _problems(self, part: Part, shots: Sequence[RecordedImage]) -> list[Problem]:
        problems = missing_files(_recorded(part))
        for index, name in enumerate(part.cameras):
            images = [shot.file for shot in shots if shot.camera == index]
            mask, size = part.table.cameras[name].ego_mask, part.table.cameras[name].size
            problems += check_camera_images(name, images, [mask] if mask else [], decode=False)
            problems += check_image_sizes(name, size, images)
        if self.lidar and part.table.lidar.vehicle_from_lidar is not None:
            unposed = [place for place in part.places if part.table.frames[place].world_from_vehicle is None]
            problems += [_no_pose(part, place) for place in unposed if part.table.frames[place].sweep is not None]
        problems += self.given.check((part.cameras[shot.camera], shot.stem) for shot in shots)
        return problems or check_extent([(part.table.path, shot.world_from_camera[:3, 3]) for shot in shots])


def _recorded(part: Part) -> list[Path]:
    """Images, masks and points, each once."""
    masks = [mask for name in part.cameras if (mask := part.table.cameras[name].ego_mask)]
    images = [frame.images[name].path for frame in part.frames for name in part.cameras if name in frame.images]
    sweeps = [frame.sweep for frame in part.frames if frame.sweep is not None]
    return list(dict.fromkeys((*masks, *images, *sweeps)))


def _no_pose(part: Part, place: int) -> Problem:
    message = f"frames[{place}] has points in the lidar's frame, but no world_from_vehicle"
    return Problem(part.table.path, message, "write it, or write points in the world and leave out vehicle_from_lidar")
