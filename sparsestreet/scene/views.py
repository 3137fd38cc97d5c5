"""``views.json``: from where and when a log was seen. A scene beside it can be rendered without the log."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.trajectories import frame_periods
from sparsestreet.records.strict_json import EXACT, decoded_json, json_line, read_text, version, write_atomically
from sparsestreet.types import Camera, Shutter, Side, View

FORMAT = 2
VIEWS_FILE = "views.json"
"""Name of the file in a run's folder."""

DEFAULT_FRAME_RATE = 10.0
"""Frames a second that a log without a clock is taken to have: as Waymo, KITTI, PandaSet and Argoverse."""

_REMEDY = (
    "one below 2 is of an earlier version, without the clock of the log: train again, or go on with the version that "
    "wrote it; one above 2 needs a newer version"
)

Numbers = tuple[float, ...]
Matrix = tuple[Numbers, ...]


@dataclass(frozen=True)
class RecordedViews:
    """The views of a log, each with both of its indices."""

    training: tuple[View, ...]
    held_out: tuple[View, ...]
    frame_rate: float | None = None
    """Frames of the log a second; None: not known."""

    @property
    def all(self) -> tuple[View, ...]:
        """Training and held-out views in order of their frames, those of one frame in order of their cameras."""
        return tuple(sorted((*self.training, *self.held_out), key=lambda view: (view.frame_index, view.camera_index)))


def seconds_of(views: RecordedViews, frame_rate: float) -> float:
    """How many seconds of the log normalized time 0 to 1 is: by its clock, else at so many frames a second."""
    with_clock = [view for view in views.all if view.seconds is not None]
    if with_clock:
        first, last = min(with_clock, key=attrgetter("time")), max(with_clock, key=attrgetter("time"))
        if last.time > first.time and last.seconds is not None and first.seconds is not None:
            return (last.seconds - first.seconds) / (last.time - first.time)
    return frame_periods(views.all) / frame_rate


@dataclass(frozen=True)
class _Entry:
    """One view as JSON."""

    split: str
    frame_index: int
    camera_index: int
    time: float = field(metadata=EXACT)
    width: int
    height: int
    camera_from_world: Matrix = field(metadata=EXACT)
    intrinsics: Matrix = field(metadata=EXACT)
    distortion: Numbers | None = field(default=None, metadata=EXACT)
    shutter_translation: Numbers | None = field(default=None, metadata=EXACT)
    shutter_rotation: Numbers | None = field(default=None, metadata=EXACT)
    shutter_direction: str | None = None
    """None with a shutter: "top", the only direction of files without this key."""
    shutter_seconds: float = field(default=0.0, metadata=EXACT)
    shutter_span: float = field(default=0.0, metadata=EXACT)
    exposure: float = field(default=0.0, metadata=EXACT)
    seconds: float | None = field(default=None, metadata=EXACT)
    stamp: int | None = None


@dataclass(frozen=True)
class _File:
    frame_rate: float | None
    views: tuple[_Entry, ...]
    format: int = version(FORMAT, _REMEDY)


def write_views(
    path: Path | str,
    training: Sequence[View],
    held_out: Sequence[View],
    frame_rate: float | None = None,
) -> None:
    """Write the cameras, times and indices of views, the whole file or nothing. A Frame's pixels are not touched.

    ``frame_rate`` is that of the log, frames a second; None: not known.

    Poses are written as float32. Raises ValueError for a view without frame or camera index, or with a number that is
    not finite.
    """
    path = Path(path)
    entries = [_entry("training", view) for view in training] + [_entry("held_out", view) for view in held_out]
    # A view a line: short enough to read, and a diff shows which view changed.
    lines = ",\n".join(json_line(entry, f"{path}: view {index}") for index, entry in enumerate(entries))
    head = json_line({"format": FORMAT, "frame_rate": frame_rate}, str(path)).removesuffix("}")
    write_atomically(path, f'{head}, "views": [\n{lines}\n]}}\n')


def read_views(path: Path | str) -> RecordedViews:
    """Read what ``write_views`` wrote.

    Raises FileNotFoundError where there is no such file, ValueError, naming file and entry, for one that is damaged
    or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no {path}: training writes a {VIEWS_FILE} into the folder of its run")
    return parsed_views(read_text(path), str(path))


def parsed_views(text: str, where: str) -> RecordedViews:
    """Does the same with the text of such a file. Raises ValueError naming ``where`` and the entry."""
    file = decoded_json(text, _File, where)
    views: dict[str, list[View]] = {"training": [], "held_out": []}
    for index, entry in enumerate(file.views):
        if entry.split not in views:
            raise ValueError(f"{where}: view {index} has split {entry.split!r}, which is none of {', '.join(views)}")
        views[entry.split].append(_view(entry, f"{where}: view {index}"))
    return RecordedViews(tuple(views["training"]), tuple(views["held_out"]), file.frame_rate)


def _entry(split: str, view: View) -> _Entry:
    camera = view.camera
    if view.frame_index is None or view.camera_index is None:
        raise ValueError(
            f"a recorded view has a frame and a camera index, got {view.frame_index} and {view.camera_index}"
        )
    return _Entry(
        split=split,
        frame_index=view.frame_index,
        camera_index=view.camera_index,
        time=view.time,
        width=camera.width,
        height=camera.height,
        camera_from_world=_matrix(camera.camera_from_world),
        intrinsics=_matrix(camera.intrinsics),
        distortion=None if camera.distortion is None else _numbers(camera.distortion),
        shutter_translation=None if camera.shutter is None else _numbers(camera.shutter.translation),
        shutter_rotation=None if camera.shutter is None else _numbers(camera.shutter.rotation),
        shutter_direction=None if camera.shutter is None else camera.shutter.direction,
        shutter_seconds=0.0 if camera.shutter is None else camera.shutter.seconds,
        shutter_span=0.0 if camera.shutter is None else camera.shutter.span,
        exposure=camera.exposure,
        seconds=view.seconds,
        stamp=view.stamp,
    )


def _view(entry: _Entry, where: str) -> View:
    shutter = None
    if entry.shutter_translation is not None and entry.shutter_rotation is not None:
        shutter = Shutter(
            _tensor(entry.shutter_translation, (3,), where, "shutter_translation"),
            _tensor(entry.shutter_rotation, (3,), where, "shutter_rotation"),
            _direction(entry.shutter_direction, where),
            entry.shutter_seconds,
            entry.shutter_span,
        )
    camera = Camera(
        _tensor(entry.camera_from_world, (4, 4), where, "camera_from_world"),
        _tensor(entry.intrinsics, (3, 3), where, "intrinsics"),
        entry.width,
        entry.height,
        None if entry.distortion is None else _tensor(entry.distortion, (5,), where, "distortion"),
        shutter,
        entry.exposure,
    )
    return View(camera, entry.time, entry.frame_index, entry.camera_index, entry.seconds, entry.stamp)


def _direction(name: str | None, where: str) -> Side:
    for side in get_args(Side):
        if side == (name or "top"):
            return side
    raise ValueError(f"{where}: shutter_direction must be one of {', '.join(get_args(Side))}, got {name!r}")


def _matrix(values: Float[Tensor, "r c"]) -> Matrix:
    return tuple(_numbers(row) for row in values)


def _numbers(values: Float[Tensor, " n"]) -> Numbers:
    # The shortest decimal that is this float32: 0.1, not 0.10000000149011612.
    return tuple(float(str(value)) for value in values.detach().float().cpu().numpy())


def _tensor(values: Numbers | Matrix, shape: tuple[int, ...], where: str, name: str) -> Tensor:
    lengths = {len(row) for row in values if isinstance(row, tuple)}
    if len(values) != shape[0] or (len(shape) == 2 and lengths != {shape[1]}):
        raise ValueError(f"{where}: {name} must be {' x '.join(map(str, shape))} numbers, got {values}")
    return torch.tensor(values)
