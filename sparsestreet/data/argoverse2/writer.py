"""Writes a log as Argoverse 2's sensor data set is shipped: feather tables, sweeps and images named by their stamps."""

import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

from sparsestreet.data.argoverse2.drive import Drive, category
from sparsestreet.data.argoverse2.feather import pyarrow_of
from sparsestreet.data.argoverse2.layout import POSES
from sparsestreet.data.directions import name_losses
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.losses import mask_losses, moved_boxes, object_losses, point_losses
from sparsestreet.data.pinhole_frames import PinholeFrames, lens_losses
from sparsestreet.data.writer import LogFile, LogWriter


@dataclass(frozen=True)
class Argoverse2Writer(LogWriter):
    """A log in a folder of its name. Masks lie in it, as ``data.log.masks`` takes them. Needs pyarrow."""

    jpeg_quality: int | None = 95
    """Of images; None: PNGs, under the names of JPEGs, which whoever looks at the bytes reads."""
    half: bool = True
    """Points in float16, as the data set has them; False: in float32."""
    masks: bool = True
    """False: none are written."""

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        """Raises ValueError for a camera whose lens changes, and for stamps that do not increase."""
        arrow, drive, frames = pyarrow_of(), Drive(log, self.half), PinholeFrames(log)
        root = drive.name
        tables = {
            POSES: drive.poses,
            "calibration/intrinsics.feather": drive.intrinsics,
            "calibration/egovehicle_SE3_sensor.feather": drive.mounts,
        }
        for path, table in tables.items():
            yield LogFile(f"{root}/{path}", partial(_feather, arrow, table))
        for view in log.views:
            name, stamp = drive.names[view.indices[1]], drive.times.of_view(view)
            path = f"{root}/sensors/cameras/{name}/{stamp}.jpg"
            yield LogFile(path, partial(frames.image, view.indices, self.jpeg_quality))
            if self.masks:
                yield from drive.masks(frames, view, name, str(stamp))
        for frame, stamp in enumerate(drive.stamps):
            yield LogFile(
                f"{root}/sensors/lidar/{stamp}.feather", partial(_feather, arrow, partial(drive.sweep, frame))
            )
        if log.tracks:
            yield LogFile(f"{root}/annotations.feather", partial(_feather, arrow, drive.boxes))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        drive = Drive(log, self.half)
        return (
            *drive.placed.time_losses(),
            *name_losses(drive.placed, drive.names),
            *lens_losses(log),
            *drive.losses(),
            *moved_boxes(drive.placed, lambda _, frame: drive.stamps[frame]),
            *object_losses(log, category),
            *point_losses(log),
            *(mask_losses(log) if self.masks else ()),
        )


def _feather(arrow: ModuleType, columns: Callable[[], dict[str, Any]]) -> Iterable[bytes]:
    from pyarrow import feather

    file = io.BytesIO()
    feather.write_feather(arrow.table(columns()), file)
    yield file.getvalue()
