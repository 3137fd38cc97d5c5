"""Writes a log as a sequence of PandaSet."""

import gzip
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sparsestreet.data.directions import ego_losses, name_losses
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.losses import mask_losses, moved_boxes, object_losses, point_losses
from sparsestreet.data.pandaset.labels import label
from sparsestreet.data.pandaset.layout import EGO_ROWS, OWN_CAR, Layout
from sparsestreet.data.pandaset.pickled import pickled_table
from sparsestreet.data.pandaset.sequence import WrittenSequence
from sparsestreet.data.pandaset.tables import PER_SECOND
from sparsestreet.data.pinhole_frames import PinholeFrames, lens_losses
from sparsestreet.data.writer import LogFile, LogWriter
from sparsestreet.types import Track

_STANDS = 0.5
"""Meters between the centers of all boxes of an object that is said to stand through the scene."""
_LEAST_TILT = 0.01
"""Degrees that are told."""


@dataclass(frozen=True)
class PandaSetWriter(LogWriter):
    """One sequence, whose instants are those of the front camera. Masks lie beside it, as ``data.log.masks`` takes
    them."""

    scene: int = 1
    """Number of the sequence, where the log has no name as PandaSet's."""
    jpeg_quality: int = 95
    """Of the images, which must be JPEGs here."""
    masks: bool = True
    """False: none are written."""

    def __post_init__(self) -> None:
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality lies in 1 to 100, got {self.jpeg_quality}: say 95")
        if not 0 <= self.scene <= 999:
            raise ValueError(f"scene has three digits, got {self.scene}: say 1")

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        sequence = WrittenSequence.of(log)
        layout = Layout(Path(log.name if re.fullmatch(r"\d{3}", log.name) else f"{self.scene:03d}"))
        frames = PinholeFrames(log)
        for index, name in sequence.names.items():
            for file, value in sequence.camera_tables(index).items():
                yield _file(layout.camera(name) / f"{file}.json", partial(_text, value))
        for view in log.views:
            path = layout.image(sequence.names[view.indices[1]], view.indices[0])
            yield _file(path, partial(frames.image, view.indices, self.jpeg_quality))
            if self.masks:
                yield from frames.mask_files(view.indices, sequence.names[view.indices[1]], path.stem)
        if len(log.sweeps):
            for file, value in sequence.lidar_tables().items():
                yield _file(layout.lidar / f"{file}.json", partial(_text, value))
            for frame in range(log.num_frames):
                yield _file(layout.sweep(frame), partial(_returns, sequence, frame))
        for frame in range(log.num_frames) if log.tracks else ():
            yield _file(layout.boxes(frame), partial(_cuboids, sequence, frame))

    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        sequence = WrittenSequence.of(log)
        placed = sequence.placed
        found = [*placed.time_losses(), *name_losses(placed, sequence.names), *lens_losses(log)]
        found += ego_losses(placed, sequence.names, EGO_ROWS)
        found += moved_boxes(placed, lambda _, frame: sequence.stamps[frame])
        if (tilt := sequence.largest_tilt()) > _LEAST_TILT:
            found.append(f"boxes stand upright, while the log's lean by up to {tilt:.3g} degrees")
        found += [*object_losses(log, label), *point_losses(log), *(mask_losses(log) if self.masks else ())]
        near, total = sequence.near_returns()
        if near:
            x, y, z = OWN_CAR
            what = (
                f"{near} of {total} returns lie within {x:g} x {y:g} x {z:g} m of where the front camera has its lidar"
            )
            found.append(f"{what}: readers take them for the recording car's")
        return tuple(found)


def _file(path: Path, content: partial[Iterable[bytes]]) -> LogFile:
    return LogFile(path.as_posix(), content)


def _text(value: str) -> Iterator[bytes]:
    yield value.encode()


def _returns(sequence: WrittenSequence, frame: int) -> Iterator[bytes]:
    """Of the spinning lidar, all at one instant, with intensities of 0: a log has none."""
    sweep = sequence.sweep(frame)
    points = np.zeros((0, 3)) if sweep is None else sequence.points(sweep).numpy()
    count = len(points)
    columns = {axis: points[:, place].copy() for place, axis in enumerate("xyz")}
    others = {"i": np.zeros(count), "t": np.full(count, sequence.stamps[frame] / PER_SECOND)}
    yield _packed(columns | others | {"d": np.zeros(count, np.int64)})


def _cuboids(sequence: WrittenSequence, frame: int) -> Iterator[bytes]:
    boxes = list(sequence.boxes(frame))
    tracks, poses = [track for track, _ in boxes], np.array([pose.numpy() for _, pose in boxes]).reshape(-1, 4, 4)
    sizes = np.array([track.size.double().tolist() for track in tracks]).reshape(-1, 3)
    nothing = [""] * len(tracks)
    yield _packed(
        {
            "uuid": [track.name for track in tracks],
            "label": [label(track.class_name) for track in tracks],
            # A heading of 0 points along y, and the length lies along it.
            "yaw": np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - np.pi / 2,
            "stationary": np.array([_stands(track) for track in tracks], bool),
            "camera_used": np.full(len(tracks), -1),
            **{f"position.{axis}": poses[:, place, 3].copy() for place, axis in enumerate("xyz")},
            **{f"dimensions.{axis}": sizes[:, place].copy() for axis, place in zip("xyz", (1, 0, 2), strict=True)},
            "attributes.object_motion": nothing,
            "cuboids.sibling_id": nothing,
            "cuboids.sensor_id": np.full(len(tracks), -1),
        }
    )


def _stands(track: Track) -> bool:
    centers = track.world_from_object[:, :3, 3]
    return float((centers - centers[0]).norm(dim=1).max()) < _STANDS


def _packed(columns: dict[str, Any]) -> bytes:
    """Without the time of writing, so that equal logs have equal files."""
    return gzip.compress(pickled_table(columns), compresslevel=6, mtime=0)
