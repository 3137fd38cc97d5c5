"""Converts frozen dataclasses to JSON and back, strictly: no NaN, no unknown or missing key, whole files only.

Only a field with a default may be missing, because it is newer than some records. A field made with ``version`` holds
the number of the format. A record of another format is refused before its keys are checked.
"""

import json
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, field, fields, is_dataclass
from pathlib import Path

from sparsestreet.atomic import atomic_file, check_regular

Json = None | bool | int | float | str | list | dict
Record = typing.TypeVar("Record")

EXACT = types.MappingProxyType({"exact": True})
"""Metadata of a field whose floats are settings, not measurements. They are written without rounding."""


class RecordError(ValueError):
    """A record cannot be written or read; names the file and the entry."""


def version(number: int, remedy: str) -> typing.Any:
    """Return the field ``format`` of a record: its number, and what to do about a file of another format."""
    return field(default=number, metadata={"remedy": remedy})


def write_atomically(path: Path, text: str) -> None:
    """Write a whole file or nothing. A reader never sees half of it; a crash leaves the old file."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: object) -> None:
    """Write a frozen dataclass as indented JSON, floats with 6 significant digits.

    Raises RecordError, naming the entry, for a NaN, an infinity or a type that JSON does not have.
    """
    text = json.dumps(_encoded(value, str(path)), indent=2, allow_nan=False, ensure_ascii=False)
    write_atomically(path, text + "\n")


def json_line(value: object, where: str) -> str:
    """Return a frozen dataclass or a mapping as one line of JSON without newline; numbers, errors as ``write_json``.

    >>> json_line({"step": 3, "psnr": 24.123456789}, "progress")
    '{"step": 3, "psnr": 24.1235}'
    """
    return json.dumps(_encoded(value, where), allow_nan=False)


def read_json(path: Path, kind: type[Record]) -> Record:
    """Read a dataclass back and check every type. Raises RecordError naming the file and the entry."""
    return decoded_json(read_text(path), kind, str(path))


def read_text(path: Path) -> str:
    """The text of a record. Raises RecordError, naming the file, where it is missing or no text."""
    check_regular(path)
    try:
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, UnicodeDecodeError) as error:
        raise RecordError(f"{path}: cannot be read ({error}); write the record again") from error


def decoded_json(text: str, kind: type[Record], where: str) -> Record:
    """Does the same with a JSON text. Raises RecordError naming ``where`` and the entry."""
    return _decoded(kind, parsed(text, where), where)


def parsed(text: str, where: str) -> Json:
    """Return the value of a JSON text. Raises RecordError, naming ``where``, for NaN or anything else not strict.

    >>> parsed('{"psnr": 24.5}', "summary.json")
    {'psnr': 24.5}
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:
        raise RecordError(f"{where}: is not strict JSON ({error}); write the record again") from error
    except RecursionError as error:
        raise RecordError(f"{where}: is brackets in brackets without end; write the record again") from error


def significant(value: float, where: str) -> float:
    """Return the value rounded to 6 significant digits: far below the noise of any measurement, readable in a diff.

    Raises RecordError, naming the entry ``where``, for a NaN or an infinity.

    >>> significant(12.345678, "psnr")
    12.3457
    """
    if not math.isfinite(value):
        raise RecordError(f"{where} is {value}, which a record has no number for: store None or find the cause")
    return float(f"{value:.6g}")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _encoded(value: object, where: str, exact: bool = False) -> Json:
    if is_dataclass(value):
        return {
            entry.name: _encoded(
                getattr(value, entry.name), f"{where}: {entry.name}", entry.metadata.get("exact", exact)
            )
            for entry in fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _encoded(entry, f"{where}: {key}", exact) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [_encoded(entry, f"{where}[{index}]", exact) for index, entry in enumerate(value)]
    if isinstance(value, float):
        return value if exact and math.isfinite(value) else significant(value, where)
    if value is None or isinstance(value, bool | int | str):
        return value
    raise RecordError(f"{where} is a {type(value).__name__}, which JSON cannot hold: convert it first")


def _decoded(kind: typing.Any, value: Json, where: str) -> typing.Any:
    """Return ``value`` as ``kind``: a dataclass, dict[str, X], tuple[X, ...], X | None, or one of plain types."""
    if isinstance(kind, type) and is_dataclass(kind):
        return _decoded_dataclass(kind, value, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return _decoded_union(arguments, value, where)
    if origin is dict:
        return {key: _decoded(arguments[1], entry, f"{where}: {key}") for key, entry in _of(dict, value, where).items()}
    if origin is tuple:
        return tuple(
            _decoded(arguments[0], entry, f"{where}[{index}]") for index, entry in enumerate(_of(list, value, where))
        )
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return _of(kind, value, where)


def _decoded_union(kinds: tuple[typing.Any, ...], value: Json, where: str) -> typing.Any:
    """Return ``value`` as a union: None and one kind of any sort, or several plain kinds."""
    if type(value) in kinds:
        return value
    others = [kind for kind in kinds if kind is not types.NoneType]
    if len(others) == 1:
        return _decoded(others[0], value, where)
    names = ", ".join(getattr(kind, "__name__", str(kind)) for kind in kinds)
    raise RecordError(f"{where}: expected one of {names}, got {type(value).__name__} {value!r}")


def _decoded_dataclass(kind: type, value: Json, where: str) -> typing.Any:
    entries = _of(dict, value, where)
    hints = typing.get_type_hints(kind)
    for entry in fields(kind):
        if "remedy" in entry.metadata and entries.get(entry.name) != entry.default:
            raise RecordError(
                f"{where}: the record has format {entries.get(entry.name)}, this version reads {entry.default}: "
                f"{entry.metadata['remedy']}"
            )
    required = {entry.name for entry in fields(kind) if entry.default is MISSING and entry.default_factory is MISSING}
    names = {entry.name for entry in fields(kind)}
    missing, unknown = sorted(required - set(entries)), sorted(set(entries) - names)
    if missing or unknown:
        raise RecordError(f"{where}: {kind.__name__} lacks the keys {missing} and has unknown keys {unknown}")
    decoded = {name: _decoded(hints[name], entries[name], f"{where}: {name}") for name in names & set(entries)}
    try:
        return kind(**decoded)
    except ValueError as error:
        raise RecordError(f"{where}: {error}") from error


def _of(kind: type, value: Json, where: str) -> typing.Any:
    """Return ``value`` if it is a ``kind``; a bool is no int here. Raises RecordError otherwise."""
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise RecordError(f"{where}: expected {kind.__name__}, got {type(value).__name__} {value!r}")
    return value
