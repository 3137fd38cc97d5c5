"""``records/presets.json``: a trained scene rendered with other settings than in training."""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import version

FORMAT = 1
"""Version of ``presets.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class RenderedAs:
    """One way to render the scene, measured on the same views as the record's other ways."""

    preset: str
    """Name of the settings, as in ``render.preset``."""
    trained: bool
    """Whether training rendered with the same settings."""
    quality: dict[str, float]
    """Id of a metric of ``DEFINITIONS`` -> its mean over the views that have it."""
    psnr_to_exact: float
    """PSNR against the same scene rendered without cut-off and early stop: mean over the views, dB."""
    frame_ms: float
    """Median milliseconds from a time and a pose to a uint8 image. The presets of a record were timed in turn at each
    view, so times compare better within a record than between records."""
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


PRESETS = JsonFile("records/presets.json", PresetRecord)
