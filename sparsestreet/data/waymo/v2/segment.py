"""A segment of version 2: one file a component, each in the component's folder."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.problems import Problem, fault
from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    REMEDY,
    BoxLabel,
    ImageMotion,
    Returns,
    Segment,
    transform,
)
from sparsestreet.data.waymo.v2 import components
from sparsestreet.data.waymo.v2.range_images import pack_poses, pack_returns, unpack
from sparsestreet.data.waymo.v2.tables import CAMERA, FRAME, LASER, OBJECT, SEGMENT, Table, data_of

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
        self._poses = {row[FRAME]: components.matrix(row, VEHICLE_POSE, self.source) for row in poses}
        if not self._poses or not all(isinstance(stamp, int) for stamp in self._poses):
            raise fault(self.source, f"the column {FRAME} does not hold a time a frame", REMEDY)
        self.stamps = sorted(self._poses)
        self.cameras = components.read_cameras(self._table("camera_calibration", "CameraCalibrationComponent"))
        table = self._optional("lidar_calibration", "LiDARCalibrationComponent")
        self.lidars = {} if table is None else components.read_lidars(table)
        self.notes = self._absent()

    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        return transform(self._poses[self.stamps[frame]], self.source, f"frame {frame}: pose")

    def images(self, frame: int) -> Mapping[str, ImageMotion]:
        path = self._images.path
        rows = self._image_rows[self.stamps[frame]].items()
        return {name: components.read_motion(row, path, f"frame {frame}, camera {name}") for name, row in rows}

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
        return frozenset((numbers[stamp], name) for stamp, name in self._divisors if stamp in numbers)

    def panoptic(self, frame: int, camera: str) -> tuple[bytes, int]:
        key = self.stamps[frame], camera
        return self._read_label(key), self._divisors[key]

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

    def check_files(self) -> list[Problem]:
        return []

    @cached_property
    def _images(self) -> Table:
        return self._table("camera_image", "CameraImageComponent")

    @cached_property
    def _image_rows(self) -> Mapping[int, dict[str, dict[str, Any]]]:
        columns = [components.POSE, *components.VELOCITY, *components.TIMES]
        found: dict[int, dict[str, dict[str, Any]]] = defaultdict(dict)
        for place, row in enumerate(self._images.rows([FRAME, CAMERA], columns)):
            name = components.sensor(row[CAMERA], CAMERAS, self._images.path)
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
            rows = synced_table.rows([FRAME, OBJECT], [components.SEEN_BY, *components.SEEN_BOX])
            synced, synced_path = {(row[FRAME], row[OBJECT]): row for row in rows}, synced_table.path
        found: dict[int, list[BoxLabel]] = defaultdict(list)
        for row in table.rows([FRAME, OBJECT], ["type", *components.BOX]):
            other = synced.get((row[FRAME], row[OBJECT]))
            found[row[FRAME]].append(components.read_label(row, other, table.path, synced_path))
        return found

    @cached_property
    def _segmentation(self) -> tuple[Table | None, dict[tuple[int, str], tuple[int, int]]]:
        """The table, and row and divisor of each labelled image."""
        table = self._optional("camera_segmentation", "CameraSegmentationLabelComponent")
        rows = [] if table is None else table.rows([FRAME, CAMERA], [DIVISOR])
        path = self._path("camera_segmentation")
        keys = [(row[FRAME], components.sensor(row[CAMERA], CAMERAS, path)) for row in rows]
        divisors = [int(components.numbers(row, [DIVISOR], path)[0]) for row in rows]
        return table, {key: (place, divisors[place]) for place, key in enumerate(keys)}

    @cached_property
    def _divisors(self) -> dict[tuple[int, str], int]:
        return {key: divisor for key, (_, divisor) in self._segmentation[1].items()}

    @cached_property
    def _read_label(self) -> Callable[[Any], bytes]:
        table, rows = self._segmentation
        assert table is not None  # it has the rows that are asked for
        places = {key: place for key, (place, _) in rows.items()}
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
        return {(row[FRAME], components.sensor(row[LASER], LIDARS, table.path)): n for n, row in enumerate(rows)}

    def _absent(self) -> tuple[str, ...]:
        optional = ("lidar_camera_synced_box",) if self.has_boxes else ()
        return tuple(
            f"no {name}: boxes are those of the lidar, each at the instant when it was scanned"
            for name in optional
            if not self._path(name).is_file()
        )

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
