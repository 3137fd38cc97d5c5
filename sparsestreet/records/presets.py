"""``records/presets.json``: a trained scene, rendered in other ways than it was trained."""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import version

FORMAT = 1
"""Version of ``presets.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class RenderedAs:
    """One way to render the scene, over the same views as all others of the record."""

    preset: str
    """Its name, as in ``render.preset``."""
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


PRESETS = JsonFile("records/presets.json", PresetRecord)
