"""The files of a scene: what its tables say of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.nuscenes.tables import REMEDY, Row, rows_of_tokens, rows_where
from sparsestreet.data.problems import fault
from sparsestreet.geometry import quaternions as quat

LIDAR = "LIDAR_TOP"
CHANNELS = {
    "CAM_FRONT": 0.0, "CAM_FRONT_LEFT": 55.0, "CAM_FRONT_RIGHT": -55.0, "CAM_BACK_LEFT": 110.0,
    "CAM_BACK_RIGHT": -110.0, "CAM_BACK": 180.0,
}  # fmt: skip
"""The front camera first, then in DriveStudio's order; degrees to the left that each looks."""
_UNIT_TOLERANCE = 1e-3
"""By how much the length of a stored quaternion may be off: more is no rounding."""

_SAMPLE_SPREAD = 200_000_000
"""Nanoseconds: the files of a sample lie within one turn of the lidar, 50 ms."""


@dataclass(frozen=True)
class DataFile:
    """A row of sample_data: one image or sweep."""

    row: Row
    path: Path
    sample: int
    """Place of its sample in the scene."""
    keyframe: bool
    stamp: int
    """Nanoseconds: of an image when it was exposed, of a sweep when its turn ended."""


@dataclass(frozen=True)
class SceneFiles:
    """What the tables say of one scene, poses and boxes aside."""

    root: Path
    tables: Path
    row: Row
    samples: tuple[Row, ...]
    """Keyframes, in order."""
    files: Mapping[str, tuple[DataFile, ...]]
    """Channel of a camera or of the lidar -> its files, by their stamps."""
    calibrations: Mapping[str, Row]
    """Token -> row of calibrated_sensor."""
    cameras: tuple[str, ...]
    """Channels, the front one first, then in DriveStudio's order."""

    @property
    def name(self) -> str:
        return self.row.text("name")

    @cached_property
    def sample_stamps(self) -> tuple[int, ...]:
        return tuple(sample.stamp() for sample in self.samples)

    @cached_property
    def places(self) -> dict[str, int]:
        """Token of a sample -> its place in the scene."""
        return {sample.token: place for place, sample in enumerate(self.samples)}


def read_scene(root: Path, tables: Path, row: Row) -> SceneFiles:
    """The samples and files of a scene. Raises LogError for tables that contradict each other or are incomplete."""
    samples = _samples(tables, row)
    places = {sample.token: place for place, sample in enumerate(samples)}
    rows = rows_where(tables / "sample_data.json", "sample_token", places)
    _check_chain(tables / "sample_data.json", rows)
    calibrations = rows_of_tokens(
        tables / "calibrated_sensor.json", {one.text("calibrated_sensor_token") for one in rows}
    )
    channels = _channels(tables, calibrations)
    files: dict[str, list[DataFile]] = {}
    for one in rows:
        channel, modality = channels[one.text("calibrated_sensor_token")]
        if modality == "camera" or channel == LIDAR:
            files.setdefault(channel, []).append(_file(root, one, samples, places))
    ordered = {channel: tuple(sorted(found, key=lambda file: file.stamp)) for channel, found in files.items()}
    if not any(channel != LIDAR for channel in ordered):
        raise fault(tables / "sample_data.json", f"{row.text('name')} has no camera images", REMEDY)
    return SceneFiles(root, tables, row, samples, ordered, calibrations, _ordered_cameras(ordered))


def _ordered_cameras(channels: Mapping[str, object]) -> tuple[str, ...]:
    order, cameras = list(CHANNELS), sorted(channel for channel in channels if channel != LIDAR)
    return tuple(sorted(cameras, key=lambda name: order.index(name) if name in order else len(order)))


def _samples(tables: Path, scene: Row) -> tuple[Row, ...]:
    """The keyframes of a scene in their order, which stamps and links tell alike."""
    path = tables / "sample.json"
    rows = sorted(rows_where(path, "scene_token", {scene.token}), key=Row.stamp)
    count = scene.count("nbr_samples")
    if len(rows) != count or not rows:
        raise fault(path, f"{scene.text('name')} has {len(rows)} samples, scene.json says {count}", REMEDY)
    for before, after in pairwise(rows):
        if before.text("next") != after.token or after.text("prev") != before.token:
            raise after.fault("prev", f"must link to the sample before it, {before.token!r}", after.text("prev"))
        if before.stamp() == after.stamp():
            raise after.fault("timestamp", "must be later than that of the sample before it", after.stamp() // 1000)
    ends = scene.text("first_sample_token"), scene.text("last_sample_token")
    if ends != (rows[0].token, rows[-1].token):
        raise scene.fault("first_sample_token, last_sample_token", "must be the ends of its samples", ends)
    return tuple(rows)


def _check_chain(path: Path, rows: Sequence[Row]) -> None:
    """Each file's successor is a file of the scene too: so none is missing in the middle of a table."""
    tokens = {row.token for row in rows}
    if len(tokens) < len(rows):
        raise fault(path, f"{len(rows) - len(tokens)} rows of the scene have the token of another row", REMEDY)
    for row in rows:
        for link in ("prev", "next"):
            if row.text(link) and row.text(link) not in tokens:
                raise row.fault(link, "must be empty or another row of the scene", row.text(link))


def _channels(tables: Path, calibrations: Mapping[str, Row]) -> dict[str, tuple[str, str]]:
    """Token of a calibrated sensor -> channel and modality."""
    sensors = rows_of_tokens(tables / "sensor.json", {row.text("sensor_token") for row in calibrations.values()})
    named = {token: (row.text("channel"), row.text("modality")) for token, row in sensors.items()}
    return {token: named[row.text("sensor_token")] for token, row in calibrations.items()}


def _file(root: Path, row: Row, samples: Sequence[Row], places: Mapping[str, int]) -> DataFile:
    name = PurePosixPath(row.text("filename"))
    if name.is_absolute() or ".." in name.parts or not name.name or "\0" in str(name):
        raise row.fault("filename", "must be a path below the data set's folder", str(name))
    place = places[row.text("sample_token")]
    file = DataFile(row, root / name, place, row.flag("is_key_frame"), row.stamp())
    if file.keyframe and abs(file.stamp - samples[place].stamp()) > _SAMPLE_SPREAD:
        raise row.fault("timestamp", f"must be near its sample's {samples[place].stamp() // 1000}", file.stamp // 1000)
    return file


def pose_of(row: Row) -> Float64[Tensor, "4 4"]:
    """``translation``, meters, and ``rotation``, wxyz, as a matrix."""
    rotation = row.numbers("rotation", (4,))
    if abs(np.linalg.norm(rotation) - 1) > _UNIT_TOLERANCE:
        raise row.fault("rotation", "must be a unit quaternion", rotation.tolist())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = quat.to_matrix(torch.from_numpy(rotation))
    pose[:3, 3] = torch.from_numpy(row.numbers("translation", (3,)))
    return pose
