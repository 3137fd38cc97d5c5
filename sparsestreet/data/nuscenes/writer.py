"""Writes a log as nuScenes is published: thirteen tables, and the images and sweeps that they name."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from sparsestreet.data.directions import ego_losses, name_losses, names_by_direction
from sparsestreet.data.encoded import png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes
from sparsestreet.data.losses import mask_losses, moved_boxes, object_losses, point_losses
from sparsestreet.data.nuscenes.cameras import EGO_ROWS
from sparsestreet.data.nuscenes.categories import category
from sparsestreet.data.nuscenes.rows import MAP, MICROSECOND, Rows, SceneRows
from sparsestreet.data.nuscenes.scene import CHANNELS
from sparsestreet.data.nuscenes.sweeps import COLUMNS, OWN_CAR
from sparsestreet.data.pinhole_frames import PinholeFrames, lens_losses
from sparsestreet.data.placed import PlacedLog
from sparsestreet.data.writer import LogFile, LogWriter

TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip

EARLIEST = 1_000_000_000
"""Nanoseconds: least stamp of what is written. nuScenes has none below 0."""


@dataclass(frozen=True)
class NuScenesWriter(LogWriter):
    """One scene, every instant of which is a sample. Masks lie beside it, as ``data.log.masks`` takes them."""

    version: str = "v1.0-mini"
    """Folder of the tables, by which nuScenes' own kit knows them."""
    jpeg_quality: int | None = 95
    """Of the images; None: PNGs, which have no loss."""
    masks: bool = True
    """False: none are written."""

    def __post_init__(self) -> None:
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality lies in 1 to 100, got {self.jpeg_quality}: say 95, or null for PNGs")
        if not re.fullmatch(r"v[\w.-]+", self.version):
            raise ValueError(f"version is a folder whose name starts with v, got {self.version!r}: say v1.0-mini")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        rows, frames = self._rows(log), PinholeFrames(log)
        for view in log.views:
            path = rows.image_path(view)
            yield LogFile(path, partial(frames.image, view.indices, self.jpeg_quality))
            if self.masks:
                stem = path.rpartition("/")[2].rpartition(".")[0]
                yield from frames.mask_files(view.indices, rows.channels[view.indices[1]], stem)
        for place, index in enumerate(log.sweeps.indices):
            if index in rows.frames:
                yield LogFile(rows.sweep_path(index), partial(_sweep, rows, place))
        yield LogFile(MAP, _empty_map)
        tables = cache(rows.tables)
        for name in TABLES:
            yield LogFile(f"{self.version}/{name}.json", partial(_table, tables, name))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        rows = self._rows(log)
        returns, placed = rows.returns, rows.placed
        found = [*placed.time_losses(MICROSECOND), *name_losses(placed, rows.channels), *lens_losses(log)]
        found += ego_losses(placed, rows.channels, EGO_ROWS)
        found += moved_boxes(placed, lambda _, frame: rows.sample_stamps.get(frame), MICROSECOND)
        found += [*object_losses(log, category), *point_losses(log), *(mask_losses(log) if self.masks else ())]
        if returns.near:
            what = f"{returns.near} of {returns.total} returns lie within {OWN_CAR} m of where the lidar is put"
            found.append(f"{what}, 0.3 m above the first camera: readers take them for the recording car's")
        unseen = sum(not any(returns.counts.get((one.name, at)) for at in one.frames.tolist()) for one in log.tracks)
        if unseen and returns.total:
            found.append(f"{unseen} of {len(log.tracks)} objects hold no return at any instant: readers leave them out")
        return tuple(found)

    def _rows(self, log: DrivingLog) -> SceneRows:
        placed = PlacedLog(log, LogTimes.of(log, EARLIEST))
        return SceneRows(
            placed, names_by_direction(placed, CHANNELS, "CAM_"), "png" if self.jpeg_quality is None else "jpg"
        )


def _sweep(rows: SceneRows, place: int) -> Iterator[bytes]:
    """Intensities and rings are 0: a log has none."""
    (sweep,) = rows.placed.log.sweeps.at([place]).gray()
    table = np.zeros((len(sweep.points), COLUMNS), "<f4")
    table[:, :3] = rows.sweep_points(sweep).numpy()
    yield table.tobytes()


def _table(tables: Callable[[], dict[str, Rows]], name: str) -> Iterator[bytes]:
    """A row on a line."""
    between = "[\n"
    for row in tables()[name]:
        yield f"{between}{json.dumps(row)}".encode()
        between = ",\n"
    yield b"\n]\n" if between == ",\n" else b"[]\n"


def _empty_map() -> Iterator[bytes]:
    """nuScenes' own kit opens no tables without a map."""
    yield png(np.zeros((4, 4), np.uint8))
