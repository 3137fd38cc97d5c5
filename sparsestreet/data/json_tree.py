"""Values of a JSON file that know where they stand, so that an error names file and field."""

import json
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.problems import LogError, fault

_MAX_FILE = 128_000_000
"""Bytes; Python's values of such a file take ten times as many."""
_MAX_NUMBER = 1e15
_LATEST = 2**63


@dataclass(frozen=True)
class JsonValue:
    """A value of a file. What is asked of it and is not there raises LogError with the file, the field and a remedy."""

    file: Path
    where: str
    """Such as ``frames[3].file_path``; empty at the top."""
    value: Any

    def fault(self, message: str, remedy: str) -> LogError:
        return fault(self.file, f"{self.where or 'the file'} {message}", remedy)

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def __getitem__(self, key: str) -> "JsonValue":
        """The entry of an object; null counts as absent."""
        self._must_be(dict, "an object in braces")
        if self.value.get(key) is None:
            raise self.fault(f"has no {key!r}", "write it")
        return JsonValue(self.file, f"{self.where}.{key}" if self.where else key, self.value[key])

    def get(self, key: str) -> "JsonValue | None":
        if key not in self:
            return None
        return self[key]

    def only(self, *keys: str) -> "JsonValue":
        """The value itself, an object of these entries and no other: a slip in a name must not go unseen."""
        self._must_be(dict, "an object in braces")
        if unknown := [key for key in self.value if key not in keys]:
            raise self.fault(f"has {unknown[0][:40]!r}, which nothing reads", f"write one of {', '.join(keys)}")
        return self

    def unread(self, known: Collection[str]) -> list[str]:
        """Name of an object's entries that are none of ``known``; null counts as absent."""
        self._must_be(dict, "an object in braces")
        return [key for key in self.value if key in self and key not in known]

    def entries(self) -> Iterator[tuple[str, "JsonValue"]]:
        """Name and values of an object, in its order."""
        self._must_be(dict, "an object in braces")
        return ((key, self[key]) for key in self.value if key in self)

    def items(self) -> list["JsonValue"]:
        """Of a list."""
        self._must_be(list, "a list in brackets")
        return [JsonValue(self.file, f"{self.where}[{index}]", value) for index, value in enumerate(self.value)]

    def text(self) -> str:
        self._must_be(str, "a text in quotes")
        return self.value

    def truth(self) -> bool:
        self._must_be(bool, "true or false")
        return self.value

    def number(self, *, positive: bool = False) -> float:
        """Finite, and of a size that lengths, pixels and angles may have."""
        if isinstance(self.value, bool) or not isinstance(self.value, (int, float)):
            raise self.fault(f"is {_shown(self.value)}, not a number", "write a number without quotes")
        if not abs(self.value) <= _MAX_NUMBER or (positive and self.value <= 0):
            message = f"must be {'positive' if positive else 'finite'}, it is {_shown(self.value)}"
            raise self.fault(message, "write the value of the calibration or of the pose")
        return float(self.value)

    def moment(self) -> float | int:
        """A time in whatever unit, finite: it may be a whole number of nanoseconds, of which a float loses the last."""
        if isinstance(self.value, int) and not isinstance(self.value, bool) and abs(self.value) < _LATEST:
            return self.value
        if not isinstance(self.value, float) or not math.isfinite(self.value):
            raise self.fault(f"is {_shown(self.value)}, no time", "write a finite number, in the same unit everywhere")
        return self.value

    def whole(self, low: int, high: int) -> int:
        """A whole number between two limits, both included."""
        value = self.value
        if isinstance(value, float) and math.isfinite(value) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.fault(f"must be a whole number from {low} to {high}, it is {_shown(self.value)}", "write one")
        return value

    def numbers(self, count: int | None = None) -> tuple[float, ...]:
        values = tuple(item.number() for item in self.items())
        if count is not None and len(values) != count:
            raise self.fault(f"has {len(values)} numbers, not {count}", f"write {count} numbers")
        return values

    def matrix(self, rows: int, columns: int) -> Float64[Tensor, "rows columns"]:
        """A list of rows."""
        values = [row.numbers(columns) for row in self.items()]
        if len(values) != rows:
            raise self.fault(f"has {len(values)} rows, not {rows}", f"write {rows} rows of {columns} numbers")
        return torch.tensor(values, dtype=torch.float64)

    def path(self) -> Path:
        """A file's name, relative to the JSON's folder and inside of it. Backslashes of Windows separate folders,
        unless a file has them in its name."""
        name = self.text()
        inside = Path(name)
        if "\\" in name and "\0" not in name and not (self.file.parent / inside).is_file():
            inside = Path(name.replace("\\", "/"))
        outside = inside.is_absolute() or PureWindowsPath(name).drive or ".." in inside.parts
        if not name or "\0" in name or outside:
            message = f"is {_shown(name)}, which is no file below the folder of {self.file.name}"
            raise self.fault(message, "name it relative to that folder, without '..'")
        return self.file.parent / inside

    def _must_be(self, kind: type, words: str) -> None:
        if not isinstance(self.value, kind):
            raise self.fault(f"is {_shown(self.value)}, not {words}", f"write {words}")


def read_json(path: Path) -> JsonValue:
    """The value of a JSON file. Raises LogError for a file that is missing, too large, or no JSON, and for an object
    that names something twice."""
    remedy = "write the file again"
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or name the folder that holds it")
    if path.stat().st_size > _MAX_FILE:
        message = f"the file has {path.stat().st_size:,} bytes, more than the {_MAX_FILE:,} that are read"
        raise fault(path, message, "write numbers with fewer digits, or split the recording")
    try:
        return JsonValue(path, "", json.loads(path.read_bytes(), object_pairs_hook=unique))
    except RecursionError as error:
        raise fault(path, "the file is no JSON that can be read (brackets in brackets without end)", remedy) from error
    except (OSError, ValueError) as error:
        raise fault(path, f"the file is no JSON ({error})", remedy) from error


def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON, for ``json.loads``; raises ValueError for a name that stands twice."""
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"an object names {next(name for name in names if names.count(name) > 1)!r} twice")
    return content


def _shown(value: Any) -> str:
    """The start of a value; what holds much is not spelled out."""
    if isinstance(value, (dict, list)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and abs(value) > _MAX_NUMBER:
        return "a number of too many digits"
    return f"{value!r:.40}"
