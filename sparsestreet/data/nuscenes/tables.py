"""Rows of nuScenes' tables: those that a scene needs, out of files of a gigabyte."""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, fault

_CHUNK = 1 << 22
"""Bytes read at a time."""
_LONGEST_ROW = 1 << 20
"""Bytes; genuine rows have below 1 kB."""
_LARGEST_WHOLE = 1 << 26
"""Bytes of a table that is parsed at once; the largest genuine one, scene.json, has below 1 MB."""
_MOST_ROWS = 1_000_000
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
    if path.is_file() and path.stat().st_size > _LARGEST_WHOLE:
        raise fault(path, f"the table has {path.stat().st_size} bytes, more than {_LARGEST_WHOLE}", REMEDY)
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
        if len(found) > _MOST_ROWS:
            raise fault(path, f"more than {_MOST_ROWS} rows belong to one scene", REMEDY)
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
