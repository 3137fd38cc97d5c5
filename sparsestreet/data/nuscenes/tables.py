"""Rows of nuScenes' tables: those that a scene needs, out of files of a gigabyte."""

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, fault
from sparsestreet.geometry import quaternions as quat

_CHUNK = 1 << 22
"""Bytes read at a time."""
_LONGEST_ROW = 1 << 20
"""Bytes; genuine rows have below 1 kB."""
_MAX_WHOLE = 1 << 26
"""Bytes of a table that is parsed at once; the largest genuine one, scene.json, has below 1 MB."""
_MAX_ROWS = 1_000_000
"""Rows of one scene in one table; a genuine scene of 20 s has about 5,000 files."""
_LAST_STAMP = 2**63 // 1000
"""Microseconds whose nanoseconds 64 bits hold."""
REMEDY = "extract the tables again from the data set's archive"


@dataclass(frozen=True)
class Row:
    """One row. What is asked for and is not there, or is of another kind, raises LogError with file, row and field."""

    path: Path
    values: Mapping[str, Any]

    @property
    def token(self) -> str:
        return self.text("token")

    def text(self, field: str) -> str:
        value = self.values.get(field)
        if not isinstance(value, str):
            raise self.fault(field, "must be text", value)
        return value

    def flag(self, field: str) -> bool:
        value = self.values.get(field)
        if not isinstance(value, bool):
            raise self.fault(field, "must be true or false", value)
        return value

    def count(self, field: str, largest: int = 1 << 31) -> int:
        """A whole number within 0 and ``largest``."""
        value = self.values.get(field)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= largest:
            raise self.fault(field, f"must be a whole number within 0 and {largest}", value)
        return value

    def stamp(self) -> int:
        """The row's microseconds, in nanoseconds."""
        value = self.values.get("timestamp")
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _LAST_STAMP:
            remedy = "write whole microseconds: seconds are multiplied by 1e6, nanoseconds divided by 1000"
            raise self.fault("timestamp", f"must be whole microseconds within 0 and {_LAST_STAMP}", value, remedy)
        return 1000 * value

    def numbers(self, field: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
        """Finite numbers in lists of this shape."""
        value = self.values.get(field)
        try:
            numbers = np.array(value)
        except ValueError as error:  # lists of several lengths
            raise self.fault(field, f"must hold numbers of shape {shape}", value) from error
        if numbers.shape != shape or numbers.dtype.kind not in "iuf" or not np.isfinite(numbers).all():
            raise self.fault(field, f"must hold finite numbers of shape {shape}", value)
        return numbers.astype(np.float64)

    def fault(self, field: str, must: str, value: object, remedy: str = REMEDY) -> LogError:
        """The error of a value that breaks a rule."""
        row = str(self.values.get("token", ""))[:40]
        shown = repr(value)
        shown = shown if len(shown) <= 80 else f"{shown[:80]} ..."
        return fault(self.path, f"row {row!r}: {field} {must}, got {shown}", remedy)


def all_rows(path: Path) -> list[Row]:
    """Every row of a small table. Raises LogError for a file that is none."""
    if path.is_file() and path.stat().st_size > _MAX_WHOLE:
        raise fault(path, f"the table has {path.stat().st_size} bytes, more than {_MAX_WHOLE}", REMEDY)
    try:
        check_regular(path)
        rows = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise _unreadable(path, error) from error
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise fault(path, "the file must be a JSON list of objects", REMEDY)
    return [Row(path, row) for row in rows]


def rows_where(path: Path, field: str, wanted: Collection[str]) -> list[Row]:
    """The rows whose text ``field`` is one of ``wanted``, in the file's order.

    The file is searched in pieces of 4 MB and only the rows found are parsed: 300 MB take 0.6 s and 6 MB of memory,
    against 3.2 s and 1.0 GB for the standard parser. Rows are taken to be flat, without braces in them, as all of
    nuScenes' are. Raises LogError for a file that is no such table.
    """
    tokens = {token.encode() for token in wanted}
    pattern = re.compile(rb'"%s"\s*:\s*"([^"\\]*)"' % field.encode())
    found: list[Row] = []
    for piece in _pieces(path):
        found += [_row(path, field, piece, match) for match in pattern.finditer(piece) if match[1] in tokens]
        if len(found) > _MAX_ROWS:
            raise fault(path, f"more than {_MAX_ROWS} rows belong to one scene", REMEDY)
    return found


def rows_of_tokens(path: Path, wanted: Collection[str]) -> dict[str, Row]:
    """Token -> its row. Raises LogError where a row is not there, or twice."""
    rows = rows_where(path, "token", wanted)
    by_token = {row.token: row for row in rows}
    absent = sorted(set(wanted) - set(by_token))
    if absent:
        message = f"{len(absent)} rows that other tables name are missing, the first is {absent[0]!r}"
        raise fault(path, message, REMEDY)
    if len(rows) > len(by_token):
        raise fault(path, f"{len(rows) - len(by_token)} rows have the token of another row", REMEDY)
    return by_token


def _pieces(path: Path) -> Iterator[bytes]:
    """A JSON list of flat objects in pieces that end behind one. Raises LogError if it is none, or is cut short."""
    rest, first = b"", True
    try:
        check_regular(path)
        with path.open("rb") as file:
            while part := file.read(_CHUNK):
                if first and not part.lstrip().startswith(b"["):
                    raise fault(path, f"the file must be a JSON list, but it starts with {part[:20]!r}", REMEDY)
                rest, first = rest + part, False
                end = rest.rfind(b"}") + 1
                yield rest[:end]
                rest = rest[end:]
                if len(rest) > _LONGEST_ROW:
                    raise fault(path, f"no row ends within {_LONGEST_ROW} bytes", REMEDY)
    except OSError as error:
        raise _unreadable(path, error) from error
    if b"".join(rest.split()) not in (b"]", b"[]"):
        raise fault(path, f"the table is cut short: it ends with {rest[-20:]!r}", REMEDY)


def _row(path: Path, field: str, piece: bytes, match: re.Match[bytes]) -> Row:
    start, end = piece.rfind(b"{", 0, match.start()), piece.find(b"}", match.end()) + 1
    try:
        values = json.loads(piece[max(start, 0) : end])
    except (ValueError, RecursionError) as error:
        message = f"the row with {field} {match[1].decode(errors='replace')[:40]!r} is no JSON object ({error})"
        raise fault(path, message, REMEDY) from error
    if not isinstance(values, dict) or values.get(field) != match[1].decode():
        raise fault(path, f"{field} {match[1].decode()[:40]!r} is not in a row of its own", REMEDY)
    return Row(path, values)


def _unreadable(path: Path, error: Exception) -> LogError:
    if isinstance(error, FileNotFoundError):
        return fault(path, "the table is missing", REMEDY)
    return fault(path, f"the table cannot be read ({error})", REMEDY)


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
