"""``edits.yaml``: edits as text, in seconds since the first frame, meters and degrees."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path as FilePath
from typing import Any

import yaml

from sparsestreet.files import read_yaml
from sparsestreet.naming import nearest, one_line
from sparsestreet.scene.edits.edits import REMOVED, Added, Edits, found, objects_of
from sparsestreet.scene.edits.nodes import Change
from sparsestreet.scene.edits.paths import AsRecorded, Driven, Held, Moved, Path
from sparsestreet.scene.storage import StoredScene

SIDES = ("forward", "right", "up", "turn", "during")
WAY = (*SIDES, "hold", "path", "hide")
KEYS = {"remove": (), "hide": (), "move": WAY, "copy": ("of", *WAY), "insert": ("scene", "of", "instead_of", *WAY),
        "replace": ("scene", "of")}  # fmt: skip

Open = Callable[[FilePath], tuple[StoredScene, float]]
"""Opens a scene by its path: it, and the seconds of its log."""


def read_edits(path: FilePath | str, seconds: float, open_scene: Open) -> Edits:
    """Read a file of edits for a scene whose log lasts so many seconds.

    ::

        remove: [car_3]
        hide: {car_4: [2.0, 4.5]}                  # seconds from when to when
        move:
          car_7: {right: 3.0, during: [1.0, 3.0]}  # a change of lane
          car_8: {hold: 2.0}                       # as it was after 2 s
          car_9: {path: [[0, 5.0, -2.0], [3, 20.0, -2.0]]}   # seconds, x, y and, if they are given, z and yaw
        copy: {second: {of: car_7, forward: -8}}
        insert: {walker: {scene: outputs/OTHER, of: pedestrian_02, path: [[0, 12.0, 1.0], [4, 12.0, 6.0]]}}
        replace: {car_5: {scene: outputs/OTHER, of: car_1}}

    Raises FileNotFoundError where there is no file, ValueError, naming file and entry, for what is wrong in it.
    """
    path = FilePath(path)
    said = read_values(path)
    try:
        return edits_of(said, seconds, lambda other: open_scene(beside(path, other)))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_values(path: FilePath | str) -> dict[str, Any]:
    """The plain values of a file of edits, not yet checked. Raises as ``read_edits`` where it has none."""
    path = FilePath(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file of edits at {path}: write one (docs/editing.md has an example)")
    said = read_yaml(path, yaml.safe_load) or {}
    try:
        _mapping(said, "the file")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return dict(said)


def edits_of(said: Mapping[str, Any], seconds: float, open_scene: Open) -> Edits:
    """The edits that plain values describe, as a file has them. Raises ValueError."""
    _known(said, KEYS, "the file")
    clock = _Clock(seconds)
    removed = said.get("remove") or []
    if not isinstance(removed, list):
        raise ValueError(f"remove: is a list of names, got {removed!r}")
    changes = {str(name): REMOVED for name in removed}
    for name, spans in _entries(said, "hide"):
        _new(changes, name)
        changes[name] = Change(hidden=clock.spans(spans, f"hide: {name}"))
    for name, entry in _entries(said, "move"):
        _new(changes, name)
        changes[name] = _change(entry, clock, f"move: {name}")
    added: dict[str, Added] = {}
    for name, entry in _entries(said, "copy"):
        added[name] = Added(_text(entry, "of", f"copy: {name}"), _change(entry, clock, f"copy: {name}"))
    for name, entry in _entries(said, "insert"):
        where = f"insert: {name}"
        added[name] = _of_scene(entry, open_scene, clock, where, entry.get("instead_of"))
    for name, entry in _entries(said, "replace"):
        _new(changes, name)
        changes[name] = REMOVED
        added[f"{name} replaced"] = _of_scene(entry, open_scene, clock, f"replace: {name}", name)
    return Edits(changes, added)


class _Clock:
    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def time(self, value: Any, where: str) -> float:
        return _number(value, where) / self.seconds

    def span(self, value: Any, where: str) -> tuple[float, float]:
        if not isinstance(value, list) or len(value) != 2:
            raise ValueError(f"{where} is [from, to] in seconds, got {value!r}")
        start, end = (self.time(one, where) for one in value)
        if start >= end:
            raise ValueError(f"{where} goes from a time to a later one, got {value}")
        return start, end

    def spans(self, value: Any, where: str) -> tuple[tuple[float, float], ...]:
        several = isinstance(value, list) and bool(value) and isinstance(value[0], list)
        return tuple(self.span(one, where) for one in (value if several else [value]))


def _of_scene(entry: Mapping[str, Any], open_scene: Open, clock: _Clock, where: str, instead_of: str | None) -> Added:
    of, change = _text(entry, "of", where), _change(entry, clock, where)
    if "scene" not in entry:
        return Added(of, change, instead_of)
    path = _text(entry, "scene", where)
    stored, seconds = open_scene(FilePath(path))
    try:
        found(objects_of(stored.scene), of)
    except ValueError as error:
        raise ValueError(f"{where}: in {path}: {error}") from error
    return Added(of, change, instead_of, stored.scene, speed=clock.seconds / seconds)


def _change(entry: Mapping[str, Any], clock: _Clock, where: str) -> Change:
    ways = [key for key in ("hold", "path") if key in entry]
    sides = [key for key in SIDES if key in entry]
    if len(ways) + bool(sides) > 1:
        raise ValueError(f"{where}: {', '.join([*ways, *sides])} exclude each other: hold, path, or a move")
    hidden = clock.spans(entry["hide"], f"{where}: hide") if "hide" in entry else ()
    return Change(_way(entry, clock, where), hidden)


def _way(entry: Mapping[str, Any], clock: _Clock, where: str) -> Path:
    if "hold" in entry:
        return Held(clock.time(entry["hold"], f"{where}: hold"))
    if "path" in entry:
        return _driven(entry["path"], clock, f"{where}: path")
    numbers = {key: _number(entry[key], f"{where}: {key}") for key in ("forward", "right", "up") if key in entry}
    turn = math.radians(_number(entry.get("turn", 0.0), f"{where}: turn"))
    during = clock.span(entry["during"], f"{where}: during") if "during" in entry else None
    return Moved(**numbers, turn=turn, during=during) if numbers or turn or during else AsRecorded()


def _driven(places: Any, clock: _Clock, where: str) -> Driven:
    lengths = {len(place) for place in places if isinstance(place, list)} if isinstance(places, list) else set()
    if len(lengths) != 1 or not lengths <= {3, 4, 5} or not all(isinstance(place, list) for place in places):
        raise ValueError(f"{where} is a list of [seconds, x, y], all with z, or all with z and yaw, got {places!r}")
    rows = [[_number(value, where) for value in place] for place in places]
    times = [row[0] / clock.seconds for row in rows]
    heights = None if lengths == {3} else [row[3] for row in rows]
    yaws = [math.radians(row[4]) for row in rows] if lengths == {5} else None
    return Driven(times, [(row[1], row[2]) for row in rows], heights, yaws)


def _entries(said: Mapping[str, Any], key: str) -> list[tuple[str, Any]]:
    entries = said.get(key) or {}
    _mapping(entries, f"{key}:")
    for name, entry in entries.items():
        if KEYS[key]:
            _mapping(entry, f"{key}: {name}")
            _known(entry, KEYS[key], f"{key}: {name}")
    return [(str(name), entry) for name, entry in entries.items()]


def _mapping(value: Any, where: str) -> None:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} has entries name: value, got {value!r}")


def _known(entry: Mapping[str, Any], keys: Any, where: str) -> None:
    for key in entry:
        if key not in keys:
            near = nearest(str(key), keys) or [", ".join(keys)]
            raise ValueError(f"{where} has no key {one_line(str(key))!r}; did you mean {near[0]}?")


def _new(changes: Mapping[str, Change], name: str) -> None:
    if name in changes:
        raise ValueError(f"{name} is edited twice: say in one entry what becomes of it")


def _text(entry: Mapping[str, Any], key: str, where: str) -> str:
    if key not in entry:
        raise ValueError(f"{where}: {key}: is missing")
    return str(entry[key])


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{where} takes finite numbers, got {value!r}")
    return float(value)


def beside(path: FilePath, other: FilePath) -> FilePath:
    """A path of the file: as it is, or else beside the file."""
    return other if other.is_absolute() or other.exists() else path.parent / other
