"""Records of measurements: one strict JSON object a line, on disk as soon as it is measured."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.ops.settings import SplatSettings

Json = None | bool | int | float | str | list | dict


@dataclass(frozen=True)
class Provenance:
    """On what, from which code and by which command something was measured; no host or user name."""

    command: str
    commit: str | None
    modified: bool | None
    """Whether tracked files differ from the commit."""
    processor: str
    cores: int
    threads: int
    system: str
    python: str
    torch: str


class RecordFile:
    """Writes records line by line; a sweep that is interrupted leaves the points it has measured."""

    def __init__(self, path: Path, provenance: Provenance) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("", encoding="utf-8")
        self.path = path
        self._provenance = encode(provenance, "provenance")

    def write(self, kind: str, record: object) -> dict[str, Json]:
        """Append a frozen dataclass as one line with its kind, the machine's load and provenance; returns the line.

        Raises ValueError, naming the entry, for a NaN, an infinity or a type that JSON does not have.
        """
        load = encode(os.getloadavg()[0], "load")
        entries = {"kind": kind, **encode(record, kind), "load": load, "provenance": self._provenance}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entries, allow_nan=False) + "\n")
        return entries


def read_records(path: Path) -> list[dict[str, Json]]:
    """All lines of a file. Raises ValueError, naming file and line, for anything that is not strict JSON."""
    records = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            records.append(json.loads(line, parse_constant=_refuse_constant))
        except ValueError as error:
            raise ValueError(f"{path}:{number} is no record ({error}): measure again") from error
    return records


def encode(value: object, where: str) -> Json:
    """Dataclasses, mappings and sequences as JSON; floats with 6 significant digits, more than any time deserves."""
    if isinstance(value, SplatSettings):
        return _settings(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: encode(getattr(value, field.name), f"{where}.{field.name}")
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): encode(entry, f"{where}.{key}") for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [encode(entry, f"{where}[{index}]") for index, entry in enumerate(value)]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.6g}")
    raise ValueError(f"{where} is {value!r}, which JSON has no value for: store None or find the cause")


def _settings(settings: SplatSettings) -> dict[str, Json]:
    """All fields; a max_sigma of infinity, which JSON cannot say, is None."""
    entries = dataclasses.asdict(settings)
    max_sigma = entries.pop("max_sigma")
    return {**encode(entries, "settings"), "max_sigma": None if math.isinf(max_sigma) else max_sigma}


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
