"""``records/presets.json``: a trained scene, rendered in other ways than it was trained (no torch)."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import read_json, version, write_json

FORMAT = 1
"""Version of ``presets.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class RenderedAs:
    """One way to render the scene, over the same views as all others of the record."""

    preset: str
    """Its name in conf/render."""
    trained: bool
    """Whether training rendered with the same settings."""
    quality: dict[str, float]
    """Id of a metric of ``DEFINITIONS`` -> its mean over the views that have it."""
    psnr_to_exact: float
    """dB; mean over the views, of this image against that of the same scene without cut-off and early stop."""
    frame_ms: float
    """Median milliseconds from a time and a pose to an image of uint8; the presets of a record were timed in turn at
    each view, so that they compare with each other better than with another record."""
    repeats: int
    """Number of timed frames."""


@dataclass(frozen=True, kw_only=True)
class PresetRecord:
    """The content of ``presets.json``."""

    format: int = version(FORMAT, "evaluate again with presets=...")
    command: str
    device: str
    threads: int
    views: int
    noise: Noise
    rendered: tuple[RenderedAs, ...]


def preset_path(run: Path) -> Path:
    """Where a run keeps how it looks otherwise."""
    return run / "records" / "presets.json"


def write_presets(path: Path, record: PresetRecord) -> None:
    """Write ``presets.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, record)


def read_presets(path: Path) -> PresetRecord:
    """Read ``presets.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, PresetRecord)
