"""Records of measurements: one strict JSON object per line, on disk as soon as it is measured."""

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from sparsestreet.ops.settings import SplatSettings
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.strict_json import Json, json_line, parsed


@dataclass(frozen=True)
class Provenance:
    """The command, the machine and the code of a measurement."""

    command: str
    threads: int
    machine: Machine
    source: CodeVersion


class RecordFile:
    """Writes records line by line; an interrupted sweep leaves what it has measured."""

    def __init__(self, path: Path, provenance: Provenance) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("", encoding="utf-8")
        self.path = path
        self._provenance = provenance

    def write(self, kind: str, record: object) -> None:
        """Appends a frozen dataclass as one line with its kind, the machine's load and provenance.

        Raises RecordError, naming the entry, for a NaN, an infinity or a type that JSON lacks.
        """
        line = {"kind": kind, **vars(record), "load": os.getloadavg()[0], "provenance": self._provenance}
        text = json_line(line, kind)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(text + "\n")


def read_records(path: Path) -> list[dict[str, Any]]:
    """Read all lines of a file. Raises RecordError, naming file and line, for anything but strict JSON."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [cast("dict[str, Any]", parsed(line, f"{path}:{number}")) for number, line in enumerate(lines, start=1)]


def settings_entries(settings: SplatSettings) -> dict[str, Json]:
    """All fields as JSON; an infinite max_sigma, which JSON lacks, is None."""
    finite = settings.max_sigma if math.isfinite(settings.max_sigma) else None
    return dataclasses.asdict(settings) | {"max_sigma": finite}
