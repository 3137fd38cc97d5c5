"""From the files of a log to a recording."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.images import image_size
from sparsestreet.data.lidar import check_points, empty_notes, returned
from sparsestreet.data.poses import PosePath, check_extent, rigid_poses
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.reader import FolderSignature, LogFiles, chosen_cameras, frame_window, listed
from sparsestreet.data.recorded_images import Pixels, RecordedImage, lowest_rows
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera

MAX_BYTES = 64_000_000
"""Bytes of a file. The largest of the data set, a sweep, takes about 2 MB."""
_REMEDY_FEATHER = "fetch the file again from its publisher"


def read_columns(path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Return columns by name, each float64, int64 or text (object), as ``columns`` says: float, int or str.

    Raises LogError for a missing or broken file, a column that lacks or has empty cells or another type, and for a file
    of more than MAX_BYTES; ModuleNotFoundError without pyarrow.
    """
    arrow = pyarrow_of()
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY_FEATHER)
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise fault(
                path, f"the file has {size:,} bytes, more than the {MAX_BYTES:,} that are read", _REMEDY_FEATHER
            )
        return _decoded(arrow, path, columns)
    except (arrow.ArrowException, OSError, ValueError) as broken:
        if isinstance(broken, LogError):
            raise
        raise fault(path, f"the file is no whole feather file ({_first_line(broken)})", _REMEDY_FEATHER) from broken


def _decoded(arrow: ModuleType, path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    with arrow.OSFile(str(path)) as file:
        schema = arrow.ipc.open_file(file).schema
        if absent := [name for name in columns if schema.get_all_field_indices(name) == []]:
            message = f"the table has no column {', '.join(absent)}, but {', '.join(schema.names[:20])}"
            raise fault(path, message, _REMEDY_FEATHER)
        wanted = sorted(schema.get_field_index(name) for name in columns)
        if wanted[0] < 0:
            raise fault(path, f"the table has two columns of one name among {', '.join(columns)}", _REMEDY_FEATHER)
        for name, kind in columns.items():
            if not _fits(arrow, schema.field(name).type, kind):
                message = f"column {name} holds {schema.field(name).type}, not {_WORDS[kind]}"
                raise fault(path, message, _REMEDY_FEATHER)
        table = arrow.ipc.open_file(file, options=arrow.ipc.IpcReadOptions(included_fields=wanted)).read_all()
        # Lengths in the metadata are believed by whoever indexes an array.
        table.validate(full=True)
    return {name: _values(arrow, path, name, table.column(name), kind) for name, kind in columns.items()}


_WORDS = {float: "numbers", int: "whole numbers", str: "text"}


def _fits(arrow: ModuleType, found: Any, kind: type) -> bool:
    types = arrow.types
    if kind is str:
        return types.is_string(found) or types.is_large_string(found)
    return types.is_integer(found) or (kind is float and types.is_floating(found))


def _values(arrow: ModuleType, path: Path, name: str, column: Any, kind: type) -> np.ndarray:
    if column.null_count:
        raise fault(path, f"column {name} has {column.null_count} empty cells", _REMEDY_FEATHER)
    if kind is str:
        return np.array(column.to_pylist(), dtype=object)
    return column.cast(arrow.int64()).to_numpy() if kind is int else column.to_numpy().astype(np.float64)


def _first_line(broken: Exception) -> str:
    return (str(broken).splitlines() or [type(broken).__name__])[0][:200]


def pyarrow_of() -> ModuleType:
    try:
        import pyarrow
        import pyarrow.ipc
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "feather files need pyarrow, which is not installed: pip install 'sparsestreet[parquet]'"
        ) from missing
    return pyarrow


POSES = "city_SE3_egovehicle.feather"
USUAL_CAMERAS = ("ring_front_center", "ring_front_left", "ring_front_right")
EGO_ROWS = {"ring_front_center": (250, 2048), "ring_rear_left": (250, 1550), "ring_rear_right": (250, 1550)}
"""How many of the lowest rows show the recording car, and of how many (NeuRAD crops these)."""
SPIN = 100_000_000
"""Nanoseconds of a turn of the lidars. The stamp of a sweep is the start of it."""
_FOLDERS = (".", "*", "*/*")
"""Of a log, below the root: the root is the log, a split, or the data set."""
_LATEST = 2**63
_REMEDY = "rename it to the nanoseconds at which it was recorded, or remove it"


@dataclass(frozen=True)
class Layout:
    """The files of one log."""

    root: Path

    @property
    def poses(self) -> Path:
        return self.root / POSES

    @property
    def boxes(self) -> Path:
        return self.root / "annotations.feather"

    @property
    def intrinsics(self) -> Path:
        return self.root / "calibration" / "intrinsics.feather"

    @property
    def mounts(self) -> Path:
        return self.root / "calibration" / "egovehicle_SE3_sensor.feather"

    @property
    def sweeps(self) -> Path:
        return self.root / "sensors" / "lidar"

    def images(self, camera: str) -> Path:
        return self.root / "sensors" / "cameras" / camera


def find_log(root: Path, scene: str | int | float | None) -> Layout:
    """The log whose name begins with ``scene``, at the root or at most two folders below.

    Raises ValueError where there is none, or more than one, or for a scene that is no text: 7e128381 is a number.
    """
    found = sorted({path.parent for folder in _FOLDERS for path in root.glob(f"{folder}/{POSES}")})
    if not found:
        raise ValueError(f"no log of Argoverse 2 is in {root}: a log's folder holds {POSES}")
    if isinstance(scene, float):
        names = listed([log.name for log in found])
        raise ValueError(f"data.log.scene is the number {scene}: put the name of the log into quotes, one of {names}")
    scene = None if scene is None else str(scene)
    logs = [log for log in found if scene is None or log.resolve().name.startswith(scene)]
    if len(logs) == 1:
        return Layout(logs[0])
    names = listed([log.name for log in logs or found])
    which = f"{len(logs)} of {len(found)} logs are named {scene}..." if scene else f"there are {len(found)} logs"
    raise ValueError(f"{which} in {root}: say data.log.scene=, the first characters of one of {names}")


def stamped_files(folder: Path, ending: str) -> dict[int, Path]:
    """Files by the nanoseconds that are their names, in order of time; empty where the folder is not there.

    Hidden files are passed over. Raises LogError for a name that is no stamp.
    """
    files = {}
    for path in folder.glob(f"*{ending}"):
        if path.name.startswith("."):
            continue
        stem = path.stem
        if not re.fullmatch("[1-9][0-9]{0,18}", stem) or int(stem) >= _LATEST:
            raise fault(path, "the name is no stamp in nanoseconds", _REMEDY)
        files[int(stem)] = path
    return dict(sorted(files.items()))


@dataclass(frozen=True)
class Selection:
    """The part of a log that is read."""

    layout: Layout
    sweeps: Mapping[int, Path]
    """All of the log's, by stamp."""
    instants: tuple[int, ...]
    """Stamps of the sweeps that are read: those of the window with an image."""
    images: Mapping[str, tuple[int | None, ...]]
    """Of each camera: the stamp of its image at each instant, where it has one."""
    dropped: int
    """Sweeps of the window without an image."""

    def image(self, camera: str, stamp: int) -> Path:
        return self.layout.images(camera) / f"{stamp}.jpg"


def select(layout: Layout, cameras: Sequence[str] | None, first_frame: int, last_frame: int) -> Selection:
    """The sweeps of a window and the image of each camera that belongs to each.

    Raises LogError for a log without sweeps or images, ValueError for cameras or frames that it does not have.
    """
    sweeps = stamped_files(layout.sweeps, ".feather")
    if not sweeps:
        raise fault(layout.sweeps, "there are no sweeps, of which each is an instant", "fetch the lidar of the log too")
    folders = layout.images("*").parent.glob("*")
    found = {path.name: stamped_files(path, ".jpg") for path in sorted(folders) if path.is_dir()}
    found = {name: files for name, files in found.items() if files}
    if not found:
        raise fault(layout.images("*").parent, "there are no images", "fetch those of the cameras that you want")
    names = cameras or [name for name in USUAL_CAMERAS if name in found] or None
    chosen = chosen_cameras(list(found), names, layout.root)
    window = frame_window(len(sweeps), first_frame, last_frame, layout.root)
    stamps = list(sweeps)[window.start : window.stop]
    matched = {name: nearest_images(stamps, list(found[name])) for name in chosen}
    kept = [place for place in range(len(stamps)) if any(one[place] is not None for one in matched.values())]
    if not kept:
        message = f"no image of {', '.join(chosen)} belongs to a sweep from {stamps[0]} to {stamps[-1]}"
        raise fault(layout.images("*").parent, message, "fetch images and sweeps of the same time")
    images = {name: tuple(one[place] for place in kept) for name, one in matched.items()}
    return Selection(layout, sweeps, tuple(stamps[place] for place in kept), images, len(stamps) - len(kept))


def nearest_images(sweeps: Sequence[int], images: Sequence[int]) -> list[int | None]:
    """For each sweep the image of a camera that is nearest to its middle; None where none is within half a turn.

    Cameras take two images a sweep, because each of the two lidars passes a camera once in a turn.
    """
    stamps = np.array(images, dtype=np.int64)
    found: list[int | None] = []
    for sweep in sweeps:
        distances = np.abs(stamps - (sweep + SPIN // 2))
        nearest = int(distances.argmin())
        image = images[nearest] if distances[nearest] <= SPIN // 2 else None
        # Sweeps that lie closer together than a turn would share an image; it belongs to the first.
        found.append(None if image in found else image)
    return found


QUATERNION, TRANSLATION, SIZE = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m"), ("length_m", "width_m", "height_m")
NEAR_DUPLICATE = 1000
"""Nanoseconds. Of poses closer together than this the first is taken: their difference is no velocity. The others lie
about 5 ms apart; in one genuine log 314 of 2,706 lie 1 to 100 ns behind another."""
LONGEST_GAP = 500_000_000
"""Nanoseconds between two poses. Over half a second the acceleration of a car (4 m/s^2) makes 12 cm."""


@dataclass(frozen=True)
class MountedCamera:
    """The calibration of one camera."""

    intrinsics: Float64[Tensor, "3 3"]
    """Pixel centers at +0.5."""
    size: tuple[int, int]
    """(width, height), pixels."""
    ego_from_camera: Float64[Tensor, "4 4"]


def read_path(layout: Layout) -> tuple[PosePath, int]:
    """The vehicle's path in the city, and how many near-duplicate poses were left out; raises LogError."""
    path = layout.poses
    table = read_columns(path, {"timestamp_ns": int} | dict.fromkeys((*QUATERNION, *TRANSLATION), float))
    stamps = table["timestamp_ns"]
    if not len(stamps):
        raise fault(path, "the table has no poses", "fetch the file again from its publisher")
    late = np.flatnonzero(np.diff(stamps) < 0)
    if len(late):
        message = f"stamps must not decrease, but row {late[0] + 1} lies before row {late[0]}"
        raise fault(path, message, "sort the rows by timestamp_ns")
    kept = np.flatnonzero(np.diff(stamps, prepend=stamps[0] - LONGEST_GAP) > NEAR_DUPLICATE)
    gaps = np.diff(stamps[kept])
    if len(gaps) and gaps.max() > LONGEST_GAP:
        message = f"{gaps.max() / 1e9:.2f} s lie between two poses, at most {LONGEST_GAP / 1e9:g} s can be interpolated"
        raise fault(path, message, "fetch the file again from its publisher")
    poses = rigid_poses(_rows(table, QUATERNION), _rows(table, TRANSLATION), path, "row")
    return PosePath(torch.from_numpy(stamps[kept]), poses[torch.from_numpy(kept)]), len(stamps) - len(kept)


def read_cameras(layout: Layout) -> dict[str, MountedCamera]:
    """Every camera that is calibrated, by name; raises LogError.

    The lens k1, k2, k3 is passed over: images are shipped without it (av2-api, issues 219 and 226). Pixels of the
    calibration have their centers at whole numbers, ours at +0.5.
    """
    kinds = {"sensor_name": str, "width_px": int, "height_px": int} | dict.fromkeys(("fx_px", "fy_px"), float)
    table = read_columns(layout.intrinsics, kinds | dict.fromkeys(("cx_px", "cy_px"), float))
    mounts = read_columns(layout.mounts, {"sensor_name": str} | dict.fromkeys((*QUATERNION, *TRANSLATION), float))
    poses = rigid_poses(_rows(mounts, QUATERNION), _rows(mounts, TRANSLATION), layout.mounts, "row")
    cameras = {}
    for row, name in enumerate(table["sensor_name"]):
        numbers = [float(table[column][row]) for column in ("fx_px", "fy_px", "cx_px", "cy_px")]
        width, height = int(table["width_px"][row]), int(table["height_px"][row])
        if not np.isfinite(numbers).all() or min(numbers) <= 0 or min(width, height) <= 0:
            message = f"{name} has fx, fy, cx, cy = {numbers} and {width} x {height} pixels, which must be positive"
            raise fault(layout.intrinsics, message, "fetch the file again from its publisher")
        fx, fy, cx, cy = numbers
        matrix = torch.tensor([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = MountedCamera(matrix, (width, height), _mount(layout, mounts["sensor_name"], poses, name))
    return cameras


def _mount(layout: Layout, names: np.ndarray, poses: Float64[Tensor, "n 4 4"], name: str) -> Float64[Tensor, "4 4"]:
    rows = np.flatnonzero(names == name)
    if len(rows) != 1:
        message = f"{name} has {len(rows)} rows, a camera has one"
        raise fault(layout.mounts, message, "fetch the file again from its publisher")
    return poses[int(rows[0])]


def read_lidar(layout: Layout) -> Float64[Tensor, "3"] | None:
    """Where the upper lidar stands in the vehicle's frame; None where the calibration has none; raises LogError.

    The lower one stands 0.1 m below it.
    """
    mounts = read_columns(layout.mounts, {"sensor_name": str} | dict.fromkeys(TRANSLATION, float))
    rows = np.flatnonzero(mounts["sensor_name"] == "up_lidar")
    return _rows(mounts, TRANSLATION)[int(rows[0])] if len(rows) else None


def read_boxes(
    layout: Layout, sweeps: Sequence[int], frames: Mapping[int, int], path: PosePath
) -> tuple[list[Boxes], int]:
    """Objects with a box at one of the instants, and how many boxes of the log have no sweep; raises LogError.

    Args:
        layout: the log.
        sweeps: stamps of all sweeps of the log.
        frames: stamp of a sweep that is read -> its instant.
        path: of the vehicle; boxes lie in its frame at the stamp of their sweep.
    """
    file = layout.boxes
    kinds = {"timestamp_ns": int, "track_uuid": str, "category": str}
    table = read_columns(file, kinds | dict.fromkeys((*SIZE, *QUATERNION, *TRANSLATION), float))
    stamps, names = table["timestamp_ns"], table["track_uuid"]
    poses = rigid_poses(_rows(table, QUATERNION), _rows(table, TRANSLATION), file, "row")
    rows = np.flatnonzero(np.isin(stamps, np.array(list(frames), dtype=np.int64)))
    # One object behind the other, each in order of time.
    rows = rows[np.lexsort((stamps[rows], names[rows].astype(str)))]
    starts = np.flatnonzero(names[rows][1:] != names[rows][:-1]) + 1
    objects = [_boxes_of_object(table, one, poses, frames, path, file) for one in np.split(rows, starts) if len(one)]
    return objects, int((~np.isin(stamps, np.array(sweeps, dtype=np.int64))).sum())


def _boxes_of_object(
    table: Mapping[str, np.ndarray],
    rows: np.ndarray,
    ego_from_box: Float64[Tensor, "n 4 4"],
    frames: Mapping[int, int],
    path: PosePath,
    file: Path,
) -> Boxes:
    """One object, of whose boxes the rows are."""
    name, stamps = str(table["track_uuid"][rows[0]]), table["timestamp_ns"][rows]
    if (twins := np.flatnonzero(np.diff(stamps) == 0)).size:
        raise fault(file, f"object {name} has two boxes at {stamps[twins[0]]}", "keep one box of an object at a time")
    return Boxes(
        name=name,
        class_name=str(table["category"][rows[0]]),
        frames=np.array([frames[int(stamp)] for stamp in stamps]),
        poses=(path.at(torch.from_numpy(stamps)) @ ego_from_box[torch.from_numpy(rows)]).numpy(),
        sizes=_rows(table, SIZE).numpy()[rows],
        path=file,
        stamps=tuple(map(int, stamps)),
    )


def read_sweep(path: Path, city_from_ego: Float64[Tensor, "4 4"]) -> Float64[Tensor, "n 3"]:
    """Points in the city, meters; raises LogError.

    They are stored in float16, in the vehicle's frame at the stamp of the sweep, both lidars together and the vehicle's
    motion taken out.
    """
    points = read_points(path)
    points = points[returned(points)]
    return points @ city_from_ego[:3, :3].T + city_from_ego[:3, 3]


def read_points(path: Path) -> Float64[Tensor, "n 3"]:
    """Points in the vehicle's frame, as ``read_sweep`` finds them."""
    points = _rows(read_columns(path, dict.fromkeys(("x", "y", "z"), float)), ("x", "y", "z"))
    check_points(points, path)
    return points


def _rows(table: Mapping[str, np.ndarray], columns: Sequence[str]) -> Float64[Tensor, "n _"]:
    return torch.from_numpy(np.stack([table[name] for name in columns], -1))


@dataclass(frozen=True, kw_only=True)
class Argoverse2Reader(RecordedReader):
    """A log of Argoverse 2's sensor data set. An instant is a sweep, at 10 Hz; cameras have instants of their own.

    The world is the city's. Pinholes, whose images are shipped without the lens, with global shutters.
    """

    marks = FolderSignature(("city_SE3_egovehicle.feather",), depth=2)

    scene: str | int | float | None = None
    """First characters of the log's name (a command line may take them for a whole number); None: the only one."""

    def recording(self) -> Recording:
        chosen = self._selection()
        path, duplicates = read_path(chosen.layout)
        _check_covered(chosen, path)
        mounts = read_cameras(chosen.layout)
        rig = [self._camera(chosen, mounts, name, index) for index, name in enumerate(chosen.images)]
        shots = _shots(chosen, mounts, path)
        boxes, homeless = _boxes(chosen, path)
        placed = [(chosen.layout.poses, shot.world_from_camera[:3, 3]) for shot in shots]
        placed += [(one.path, position) for one in boxes or () for position in torch.from_numpy(one.poses[:, :3, 3])]
        problems = check_extent(placed) + self.given.check((rig[shot.camera].name, shot.stem) for shot in shots)
        if problems:
            raise LogError(problems)
        pixels = Pixels(rig, [mounts[camera.name].size for camera in rig], self.given, lowest_rows(rig, EGO_ROWS))
        return Recording(
            name=chosen.layout.root.resolve().name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=self.given.beside(["ego"] if EGO_ROWS.keys() & chosen.images.keys() else ()),
            frame_stamps=chosen.instants,
            sweeps=_sweeps(chosen, path) if self.lidar else None,
            boxes=boxes,
            vehicle=PosePath(torch.tensor(chosen.instants), path.at(torch.tensor(chosen.instants))),
            notes=(
                *_notes(chosen, duplicates, homeless, len(shots)),
                *empty_notes(read_points, [chosen.sweeps[stamp] for stamp in chosen.instants] if self.lidar else []),
            ),
        )

    def files(self) -> LogFiles:
        chosen = self._selection()
        layout = chosen.layout
        images = [
            chosen.image(name, one) for name, stamps in chosen.images.items() for one in stamps if one is not None
        ]
        points = [chosen.sweeps[stamp] for stamp in chosen.instants] if self.lidar else []
        return LogFiles((layout.poses, layout.intrinsics, layout.mounts, layout.boxes), (*images, *points))

    def _selection(self) -> Selection:
        return select(find_log(self.folder, self.scene), self.cameras, self.first_frame, self.last_frame)

    def _camera(self, chosen: Selection, mounts: Mapping[str, MountedCamera], name: str, index: int) -> RigCamera[str]:
        if name not in mounts:
            message = f"camera {name} has images but no row"
            raise fault(chosen.layout.intrinsics, message, "fetch the file again, or name the cameras that it has")
        mount = mounts[name]
        image = chosen.image(name, next(stamp for stamp in chosen.images[name] if stamp is not None))
        if (size := image_size(image)) != mount.size:
            message = f"the image is {size[0]}x{size[1]}, the calibration says {mount.size[0]}x{mount.size[1]}"
            raise fault(image, message, "fetch images and calibration of the same log; data.log.width scales them")
        return self.pinhole(name, index, mount.intrinsics, mount.size)


def _check_covered(chosen: Selection, path: PosePath) -> None:
    """Raise LogError where the path of the vehicle begins after, or ends before, an image or a sweep that is read."""
    stamps = [one for images in chosen.images.values() for one in images if one is not None]
    for stamp in sorted((*stamps, *chosen.instants)):
        if not int(path.stamps[0]) <= stamp <= int(path.stamps[-1]):
            message = f"poses from {int(path.stamps[0])} to {int(path.stamps[-1])} do not cover what is of {stamp}"
            remedy = "read only frames with poses (data.log.first_frame, .last_frame)"
            raise fault(chosen.layout.poses, message, remedy)


def _shots(chosen: Selection, mounts: Mapping[str, MountedCamera], path: PosePath) -> list[RecordedImage]:
    """The images, each with the pose of its own stamp. All rows of one are exposed at once (the data set's guide)."""
    found = [
        (frame, camera, name, stamps[frame])
        for frame in range(len(chosen.instants))
        for camera, (name, stamps) in enumerate(chosen.images.items())
    ]
    taken = [(frame, camera, name, stamp) for frame, camera, name, stamp in found if stamp is not None]
    poses = path.at(torch.tensor([stamp for *_, stamp in taken]))
    return [
        RecordedImage(
            frame=frame,
            camera=camera,
            world_from_camera=pose @ mounts[name].ego_from_camera,
            key=chosen.image(name, stamp),
            stem=str(stamp),
            stamp=stamp,
        )
        for (frame, camera, name, stamp), pose in zip(taken, poses, strict=True)
    ]


def _sweeps(chosen: Selection, path: PosePath) -> dict[int, LidarSweep]:
    poses, place = path.at(torch.tensor(chosen.instants)), read_lidar(chosen.layout)
    stood = None if place is None else poses[:, :3, :3] @ place + poses[:, :3, 3]
    return {
        frame: LidarSweep(
            partial(read_sweep, chosen.sweeps[stamp], poses[frame]), stamp, None if stood is None else stood[frame]
        )
        for frame, stamp in enumerate(chosen.instants)
    }


def _boxes(chosen: Selection, path: PosePath) -> tuple[list[Boxes] | None, int]:
    """None where the log has none, as those of the test split."""
    if not chosen.layout.boxes.is_file():
        return None, 0
    frames = {stamp: frame for frame, stamp in enumerate(chosen.instants)}
    return read_boxes(chosen.layout, list(chosen.sweeps), frames, path)


def _notes(chosen: Selection, duplicates: int, homeless: int, shots: int) -> tuple[str, ...]:
    """What a user should know about how it was read."""
    lacking = len(chosen.instants) * len(chosen.images) - shots
    said = {
        f"{duplicates} poses within a microsecond of another one are left out": duplicates,
        f"{chosen.dropped} sweeps have no image of these cameras and are left out": chosen.dropped,
        f"{lacking} of {lacking + shots} images are missing: their instants are seen by the other cameras": lacking,
        f"{homeless} boxes are of instants whose sweeps are not here, and are left out": homeless,
    }
    return tuple(sentence for sentence, count in said.items() if count)
