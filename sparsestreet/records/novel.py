"""``records/novel.json``: what a scene shows beside the recorded path."""

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from sparsestreet.records.strict_json import read_json, version, write_json

FORMAT = 2
"""Version of ``novel.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class NovelShift:
    """One path beside the recorded one."""

    offset: float
    """Meters to the right of the rig, negative: to the left."""
    views: int
    """Number of its renders that are compared with the real images."""
    distances: dict[str, float]
    """Name of a distance, such as "frechet_alexnet" -> its value; empty where it could not be measured."""
    truth: dict[str, float]
    """"psnr_full", "psnr_human", "psnr_vehicle" -> dB, mean over the true images that have such pixels; empty where
    nobody knows the truth."""
    true_views: int
    """Number of true images: views whose camera would sit in something have none."""


@dataclass(frozen=True, kw_only=True)
class NovelRecord:
    """The content of ``novel.json``."""

    format: int = version(FORMAT, "evaluate again with novel=...")
    command: str
    ramp: bool
    """Whether the shift grows from 0 at the first instant to its whole at the last, as in a change of lane."""
    real_views: int
    """Number of real images: of the recorded views that are shifted."""
    absent: str | None
    """Why there are no distances, and what to do about it; None: there are."""
    shifts: tuple[NovelShift, ...]

    def mean(self, meters: float, distance: str) -> float | None:
        """A distance at so many meters, mean over both sides; None where it was not measured."""
        values = [one.distances.get(distance) for one in self.shifts if abs(one.offset) == meters]
        found = [value for value in values if value is not None]
        return fmean(found) if found else None


def novel_path(run: Path) -> Path:
    """Where a run keeps what was measured beside its path."""
    return run / "records" / "novel.json"


def write_novel(path: Path, record: NovelRecord) -> None:
    """Write ``novel.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, record)


def read_novel(path: Path) -> NovelRecord:
    """Read ``novel.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, NovelRecord)
