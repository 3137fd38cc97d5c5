"""Segments of Waymo's version 2: Parquet tables, a component a column."""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.frame_cache import Lock
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.reader import LogFiles
from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    REMEDY,
    BoxLabel,
    CameraCalibration,
    ImageMotion,
    LidarCalibration,
    Returns,
    Segment,
    Spool,
    box_label,
    camera_calibration,
    image_motion,
    lidar_calibration,
    returns_of,
    transform,
)

SEGMENT, FRAME = "key.segment_context_name", "key.frame_timestamp_micros"
CAMERA, LASER, OBJECT = "key.camera_name", "key.laser_name", "key.laser_object_id"
_MAX_TABLE = 256_000_000
"""Bytes of small columns that are held at once; those of a segment take a few million."""
_BYTES_OF_A_ROW, _BYTES_OF_A_CELL = 256, 64
"""What Python takes for either at least, however few bytes code them: sixty million equal cells fit into 400 kB."""
_ROWS_AT_ONCE = 4
_READ_AHEAD = 1 << 20
"""Bytes of a column that are read from the file at a time."""


class Table:
    """A component of a segment. All methods raise LogError, naming the file, for broken ones."""

    def __init__(self, path: Path, component: str) -> None:
        """``component``: the name that stands in brackets before its columns, such as CameraImageComponent."""
        self.path = path
        self._prefix = f"[{component}]."
        self._file = _opened(path)
        self._reading = Lock()
        self.columns: set[str] = self._explained(lambda: set(self._file.schema_arrow.names))

    def column(self, name: str) -> str:
        """The name of a column as the file has it; a key keeps its own."""
        return name if name.startswith("key.") else self._prefix + name

    def rows(self, keys: Sequence[str], columns: Sequence[str]) -> list[dict[str, Any]]:
        """Some columns of all rows, in Python's numbers, texts and lists."""
        wanted = [*keys, *columns]
        names = [self.column(name) for name in wanted]
        self._require(names)
        cells = self._explained(lambda: self._cells(names, *self._sizes(names)))
        return [dict(zip(wanted, row, strict=True)) for row in zip(*cells, strict=True)]

    def spooled(
        self, places: dict[Any, int], columns: Sequence[str], pack: Callable[[list[Any]], bytes]
    ) -> Callable[[Any], bytes]:
        """A function from a key to what ``pack`` made of its row.

        A group of rows is decoded from its start when one of its rows is asked for, a few rows at a time, and what was
        packed is kept in a temporary file: groups may be large.

        Args:
            places: key -> row of the file.
            columns: those that ``pack`` gets, in this order, as one Arrow scalar each.
            pack: of the cells of a row.
        """
        names = [self.column(name) for name in columns]
        self._require(names)
        keys, spool = {place: key for key, place in places.items()}, Spool()

        def keep(row: int) -> None:
            for place, cells in self._group_around(row, names):
                if place in keys:
                    spool.put(keys[place], pack(cells))

        def read(key: Any) -> bytes:
            with self._reading:
                if key not in spool:
                    self._explained(lambda: keep(places[key]))
            return spool.get(key)

        return read

    def _group_around(self, row: int, names: Sequence[str]) -> Iterator[tuple[int, list[Any]]]:
        """Place and cells of each row of the group that holds a row."""
        metadata = self._file.metadata
        counts = [metadata.row_group(number).num_rows for number in range(metadata.num_row_groups)]
        firsts = list(accumulate(counts, initial=0))
        number = bisect_right(firsts, row) - 1
        place = firsts[number]
        for batch in self._file.iter_batches(_ROWS_AT_ONCE, row_groups=[number], columns=names, use_threads=False):
            cells = [batch.column(name) for name in names]
            for inside in range(batch.num_rows):
                yield place + inside, [column[inside] for column in cells]
            place += batch.num_rows

    def _require(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise fault(self.path, f"the columns {missing[:4]} are missing", REMEDY)

    def _cells(self, names: Sequence[str], coded: int, decoded: int) -> list[list[Any]]:
        """The cells of columns, read so few rows at a time that none of the steps takes more than the largest table."""
        self._check_size(names, decoded)
        columns: list[list[Any]] = [[] for _ in names]
        # No cell is larger than the bytes that code all of them.
        rows = max(1, min(_MAX_TABLE // max(coded, 1), 65536))
        for batch in self._file.iter_batches(rows, columns=names, use_threads=False):
            decoded += batch.nbytes
            self._check_size(names, decoded)
            for cells, name in zip(columns, names, strict=True):
                cells += batch.column(name).to_pylist()
        return columns

    def _check_size(self, names: Sequence[str], size: int) -> None:
        if size > _MAX_TABLE:
            message = f"the columns {', '.join(names[:3])} ... take {size} bytes, a segment's take a few million"
            raise fault(self.path, message, REMEDY)

    def _sizes(self, names: Sequence[str]) -> tuple[int, int]:
        """Bytes that code the columns, and the least that they take in memory."""
        metadata, size, values = self._file.metadata, 0, 0
        for number in range(metadata.num_row_groups):
            group = metadata.row_group(number)
            chunks = [group.column(place) for place in range(group.num_columns)]
            # A list's column is told by its path: NAME.list.element.
            wanted = [
                chunk
                for chunk in chunks
                if chunk.path_in_schema.removesuffix(".list.element").removesuffix(".list.item") in names
            ]
            size += sum(chunk.total_uncompressed_size for chunk in wanted)
            values += sum(chunk.num_values for chunk in wanted)
        return size, size + _BYTES_OF_A_ROW * metadata.num_rows + _BYTES_OF_A_CELL * values

    def _explained(self, read: Callable[[], Any]) -> Any:
        """What ``read`` returns; errors of Arrow as those of the file."""
        import pyarrow

        try:
            return read()
        except LogError:
            raise
        except (pyarrow.ArrowException, OSError, ValueError, UnicodeDecodeError) as error:
            raise _unreadable(self.path, error) from error


def data_of(cell: Any, path: Path) -> bytes:
    """The bytes of an Arrow cell, none where it is empty."""
    value = cell.as_py() or b""
    if not isinstance(value, bytes):
        raise fault(path, f"a cell of the type {cell.type} holds no bytes", REMEDY)
    return value


def _opened(path: Path) -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        message = "tables in parquet files need pyarrow, which is not installed"
        raise fault(path, message, "pip install 'sparsestreet[parquet]'") from error
    try:
        check_regular(path)
        return pyarrow.parquet.ParquetFile(path, buffer_size=_READ_AHEAD, pre_buffer=False)
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> LogError:
    first = str(error).strip().splitlines() or [type(error).__name__]
    return fault(path, f"the table cannot be read ({first[0][:200]})", REMEDY)


INTRINSIC = [f"intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
SIZE_AND_DIRECTION = ["width", "height", "rolling_shutter_direction"]
MOUNT = "extrinsic.transform"
INCLINATION = [f"beam_inclination.{name}" for name in ("min", "max")]
INCLINATIONS = "beam_inclination.values"
POSE = "pose.transform"
VELOCITY = [f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
_SHUTTER = "rolling_shutter_params"
TIMES = [
    "pose_timestamp",
    *(f"{_SHUTTER}.{name}" for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")),
]
_BOX = ["center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading"]
BOX = [f"box.{name}" for name in _BOX]
SEEN_BOX = [f"camera_synced_box.{name}" for name in _BOX]
SEEN_BY = "most_visible_camera_name"


def sensor(value: Any, names: dict[int, str], path: Path) -> str:
    """The name of a camera or lidar from its number or its name: both are found in Waymo's files."""
    name = names.get(value) if isinstance(value, int) else value
    if not isinstance(name, str) or name not in names.values():
        raise fault(path, f"a row is of {value!r}, which is not one of {names}", REMEDY)
    return name


def numbers(row: dict[str, Any], columns: Sequence[str], path: Path) -> list[float]:
    """Cells that must be there. Raises LogError, naming file and column, for an empty one."""
    values = [row[column] for column in columns]
    for column, value in zip(columns, values, strict=True):
        if not isinstance(value, int | float):
            raise fault(path, f"a row has {value!r} as {column}, not a number", REMEDY)
    return [float(value) for value in values]


def matrix(row: dict[str, Any], column: str, path: Path) -> list[float]:
    value = row[column]
    if not isinstance(value, list) or not all(isinstance(entry, int | float) for entry in value):
        raise fault(path, f"a row has no numbers as {column}", REMEDY)
    return [float(entry) for entry in value]


def read_cameras(table: Table) -> dict[str, CameraCalibration]:
    found = {}
    for row in table.rows([CAMERA], [*INTRINSIC, MOUNT, *SIZE_AND_DIRECTION]):
        name = sensor(row[CAMERA], CAMERAS, table.path)
        width, height, direction = (int(value) for value in numbers(row, SIZE_AND_DIRECTION, table.path))
        intrinsic, mount = numbers(row, INTRINSIC, table.path), matrix(row, MOUNT, table.path)
        found[name] = camera_calibration(intrinsic, mount, (width, height), direction, table.path, name)
    return found


def read_lidars(table: Table) -> dict[str, LidarCalibration]:
    found = {}
    for row in table.rows([LASER], [MOUNT, *INCLINATION, INCLINATIONS]):
        name = sensor(row[LASER], LIDARS, table.path)
        low, high = numbers(row, INCLINATION, table.path)
        values = row[INCLINATIONS] or []
        found[name] = lidar_calibration(matrix(row, MOUNT, table.path), values, (low, high), table.path, name)
    return found


def read_motion(row: dict[str, Any], path: Path, what: str) -> ImageMotion:
    pose_time, exposure, trigger, done = numbers(row, TIMES, path)
    times = (pose_time, exposure, trigger, done)
    return image_motion(matrix(row, POSE, path), numbers(row, VELOCITY, path), times, path, what)


def read_label(row: dict[str, Any], synced: dict[str, Any] | None, path: Path, synced_path: Path) -> BoxLabel:
    """A row of lidar_box, and that of lidar_camera_synced_box with the same object, if it has one."""
    seen_box = seen_by = None
    if synced is not None:
        seen_by = sensor(synced[SEEN_BY], CAMERAS, synced_path)
        seen_box = numbers(synced, SEEN_BOX, synced_path)
    (kind,) = numbers(row, ["type"], path)
    box = numbers(row, BOX, path)
    return box_label(str(row[OBJECT] or ""), int(kind), box, path, "a frame", seen_box=seen_box, seen_by=seen_by)


_LARGEST = 2**24
"""Numbers of an image: TOP's poses are a million."""


def image(values: Any, shape: Any, channels: int, path: Path) -> np.ndarray | None:
    """rows x columns x channels float32 of two Arrow cells; None where they are empty."""
    if not values.is_valid or not shape.is_valid or not len(values.values):
        return None
    sides = shape.as_py()
    flat = values.values.to_numpy(zero_copy_only=False)
    if (
        len(sides) != 3
        or sides[2] != channels
        or min(sides) <= 0
        or math.prod(sides) != len(flat)
        or len(flat) > _LARGEST
        or flat.dtype.kind != "f"
    ):
        message = f"a range image has {len(flat)} numbers for the shape {sides}, which needs {channels} channels"
        raise fault(path, message, REMEDY)
    return flat.astype(np.float32).reshape(sides)


def pack_returns(cells: list[Any], path: Path) -> bytes:
    """Rows, columns and number of returns, then pixels and ranges: a range image is mostly empty channels."""
    pairs = zip(cells[::2], cells[1::2], strict=True)
    images = [found for found in (image(values, shape, 4, path) for values, shape in pairs) if found is not None]
    if not images:
        return b""
    returns = returns_of("", images, None)
    head = np.array([*returns.shape, len(returns.pixels)], "<i8")
    numbers = (returns.ranges.astype("<f4").tobytes(), returns.intensities.astype("<f4").tobytes())
    return b"".join((head.tobytes(), returns.pixels.astype("<i4").tobytes(), *numbers))


def pack_poses(cells: list[Any], path: Path) -> bytes:
    values, shape = cells
    found = image(values, shape, 6, path)
    if found is None:
        raise fault(path, "a row of the lidar TOP has no poses", REMEDY)
    return np.array(found.shape[:2], "<i8").tobytes() + found.astype("<f4").tobytes()


def unpack(lidar: str, packed: bytes, poses: bytes | None) -> Returns:
    """The returns, with the poses of the pixels."""
    if not packed:
        return Returns(lidar, (1, 1), np.zeros(0, np.int64), *np.zeros((2, 0), np.float32))
    height, width, count = np.frombuffer(packed, "<i8", 3).tolist()
    pixels = np.frombuffer(packed, "<i4", count, 24).astype(np.int64)
    ranges = np.frombuffer(packed, "<f4", count, 24 + 4 * count)
    intensities = np.frombuffer(packed, "<f4", count, 24 + 8 * count)
    matrix = None
    if poses is not None:
        rows, columns = np.frombuffer(poses, "<i8", 2).tolist()
        matrix = np.frombuffer(poses, "<f4", offset=16).reshape(rows, columns, 6)
    return Returns(lidar, (height, width), pixels, ranges, intensities, matrix)


VEHICLE_POSE = "world_from_vehicle.transform"
LABEL, DIVISOR = "panoptic_label", "panoptic_label_divisor"
RETURNS = [f"range_image_return{number}.{part}" for number in (1, 2) for part in ("values", "shape")]


class TableSegment(Segment):
    """Small columns are read at once, images and range images when they are asked for."""

    def __init__(self, root: Path, name: str) -> None:
        """``root``: the folder of the components. Raises LogError for a segment that lacks what is always needed."""
        self.name, self._root = name, root
        self.source, self.calibration_file = self._path("vehicle_pose"), self._path("camera_calibration")
        self.image_file, self.box_file = self._path("camera_image"), self._path("lidar_box")
        self.lidar_file, self.label_file = self._path("lidar"), self._path("camera_segmentation")
        poses = self._table("vehicle_pose", "VehiclePoseComponent").rows([SEGMENT, FRAME], [VEHICLE_POSE])
        self._check_name(poses)
        self._poses = {row[FRAME]: matrix(row, VEHICLE_POSE, self.source) for row in poses}
        if not self._poses or not all(isinstance(stamp, int) for stamp in self._poses):
            raise fault(self.source, f"the column {FRAME} does not hold a time a frame", REMEDY)
        self.stamps = sorted(self._poses)
        self.cameras = read_cameras(self._table("camera_calibration", "CameraCalibrationComponent"))
        table = self._optional("lidar_calibration", "LiDARCalibrationComponent")
        self.lidars = {} if table is None else read_lidars(table)
        if self.has_boxes and not self._path("lidar_camera_synced_box").is_file():
            note = "no lidar_camera_synced_box: boxes are those of the lidar, each at the instant when it was scanned"
            self.notes = (note,)

    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        return transform(self._poses[self.stamps[frame]], self.source, f"frame {frame}: pose")

    def images(self, frame: int) -> Mapping[str, ImageMotion]:
        path = self._images.path
        rows = self._image_rows[self.stamps[frame]].items()
        return {name: read_motion(row, path, f"frame {frame}, camera {name}") for name, row in rows}

    def jpeg(self, frame: int, camera: str) -> bytes:
        return self._read_image((self.stamps[frame], camera))

    def boxes(self, frame: int) -> Sequence[BoxLabel]:
        return self._labels.get(self.stamps[frame], ())

    @property
    def has_boxes(self) -> bool:
        return self.box_file.is_file()

    @cached_property
    def labelled(self) -> frozenset[tuple[int, str]]:
        numbers = {stamp: frame for frame, stamp in enumerate(self.stamps)}
        return frozenset((numbers[stamp], name) for stamp, name in self._label_rows if stamp in numbers)

    def panoptic(self, frame: int, camera: str) -> tuple[bytes, int]:
        key = self.stamps[frame], camera
        return self._read_label(key), self._label_rows[key][1]

    def has_returns(self, frame: int) -> bool:
        return any((self.stamps[frame], name) in self._return_places for name in LIDARS.values())

    def returns(self, frame: int) -> Sequence[Returns]:
        keys = [(self.stamps[frame], name) for name in LIDARS.values()]
        return [
            unpack(key[1], self._read_returns(key), self._read_poses(key) if key[1] == "TOP" else None)
            for key in keys
            if key in self._return_places
        ]

    def files(self) -> LogFiles:
        described = ["vehicle_pose", "camera_calibration", "lidar_calibration", "lidar_box", "lidar_camera_synced_box"]
        recorded = ["camera_image", "camera_segmentation", "lidar", "lidar_pose"]
        return LogFiles([self._path(name) for name in described], [self._path(name) for name in recorded])

    @cached_property
    def _images(self) -> Table:
        return self._table("camera_image", "CameraImageComponent")

    @cached_property
    def _image_rows(self) -> Mapping[int, dict[str, dict[str, Any]]]:
        columns = [POSE, *VELOCITY, *TIMES]
        found: dict[int, dict[str, dict[str, Any]]] = defaultdict(dict)
        for place, row in enumerate(self._images.rows([FRAME, CAMERA], columns)):
            name = sensor(row[CAMERA], CAMERAS, self._images.path)
            found[row[FRAME]][name] = row | {"place": place}
        return found

    @cached_property
    def _read_image(self) -> Callable[[Any], bytes]:
        rows = self._image_rows.items()
        places = {(stamp, name): row["place"] for stamp, images in rows for name, row in images.items()}
        return self._images.spooled(places, ["image"], lambda cells: data_of(cells[0], self._images.path))

    @cached_property
    def _labels(self) -> Mapping[int, list[BoxLabel]]:
        table = self._optional("lidar_box", "LiDARBoxComponent")
        if table is None:
            return {}
        synced_table = self._optional("lidar_camera_synced_box", "LiDARCameraSyncedBoxComponent")
        synced, synced_path = {}, table.path
        if synced_table is not None:
            rows = synced_table.rows([FRAME, OBJECT], [SEEN_BY, *SEEN_BOX])
            synced, synced_path = {(row[FRAME], row[OBJECT]): row for row in rows}, synced_table.path
        found: dict[int, list[BoxLabel]] = defaultdict(list)
        for row in table.rows([FRAME, OBJECT], ["type", *BOX]):
            other = synced.get((row[FRAME], row[OBJECT]))
            found[row[FRAME]].append(read_label(row, other, table.path, synced_path))
        return found

    @cached_property
    def _segmentation(self) -> Table | None:
        return self._optional("camera_segmentation", "CameraSegmentationLabelComponent")

    @cached_property
    def _label_rows(self) -> dict[tuple[int, str], tuple[int, int]]:
        """Row and divisor of each labelled image."""
        rows = [] if self._segmentation is None else self._segmentation.rows([FRAME, CAMERA], [DIVISOR])
        path = self.label_file
        return {
            (row[FRAME], sensor(row[CAMERA], CAMERAS, path)): (place, int(numbers(row, [DIVISOR], path)[0]))
            for place, row in enumerate(rows)
        }

    @cached_property
    def _read_label(self) -> Callable[[Any], bytes]:
        table = self._segmentation
        assert table is not None  # it has the rows that are asked for
        places = {key: place for key, (place, _) in self._label_rows.items()}
        return table.spooled(places, [LABEL], lambda cells: data_of(cells[0], table.path))

    @cached_property
    def _returns_table(self) -> Table | None:
        return self._optional("lidar", "LiDARComponent")

    @cached_property
    def _return_places(self) -> dict[tuple[int, str], int]:
        return {} if self._returns_table is None else self._places(self._returns_table)

    @cached_property
    def _read_returns(self) -> Callable[[Any], bytes]:
        table = self._returns_table
        assert table is not None  # it has the rows that are asked for
        second = [name for name in RETURNS if table.column(name) in table.columns]
        return table.spooled(self._return_places, second, lambda cells: pack_returns(cells, table.path))

    @cached_property
    def _read_poses(self) -> Callable[[Any], bytes]:
        table = self._table("lidar_pose", "LiDARPoseComponent")
        places = self._places(table)
        read = table.spooled(places, RETURNS[:2], lambda cells: pack_poses(cells, table.path))

        def checked(key: tuple[int, str]) -> bytes:
            if key not in places:
                message = f"there are no poses of lidar {key[1]} at frame {key[0]}, though it has a range image"
                raise fault(table.path, message, REMEDY)
            return read(key)

        return checked

    def _places(self, table: Table) -> dict[tuple[int, str], int]:
        rows = table.rows([FRAME, LASER], [])
        return {(row[FRAME], sensor(row[LASER], LIDARS, table.path)): n for n, row in enumerate(rows)}

    def _check_name(self, rows: Sequence[dict[str, Any]]) -> None:
        others = {row[SEGMENT] for row in rows} - {self.name}
        if others:
            message = f"the file is named after {self.name}, but has frames of {sorted(map(str, others))[:3]}"
            raise fault(self.source, message, "name each file after its segment")

    def _path(self, component: str) -> Path:
        return self._root / component / f"{self.name}.parquet"

    def _optional(self, component: str, prefix: str) -> Table | None:
        return Table(self._path(component), prefix) if self._path(component).is_file() else None

    def _table(self, component: str, prefix: str) -> Table:
        if not self._path(component).is_file():
            message = f"the component {component} of the segment is missing"
            raise fault(self._path(component), message, "download it from Waymo, into a folder of that name")
        return Table(self._path(component), prefix)
