"""Renders that no photograph shows: next to the recorded path, and with other settings than in training."""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import version

NOVEL_FORMAT = 2
"""Version of ``novel.json``; raised when a key changes its meaning."""

TRUTH = ("psnr_full", "psnr_human", "psnr_vehicle", "lpips_alex")
"""Metrics that compare a render with the true image: PSNR of all pixels, of people, of vehicles, in dB; LPIPS."""


@dataclass(frozen=True, kw_only=True)
class NovelShift:
    """One path parallel to the recorded one."""

    offset: float
    """Meters to the right of the rig; negative to the left."""
    views: int
    """Number of renders that are compared with the real images."""
    distances: dict[str, float]
    """Name of a distance, such as "frechet_alexnet" -> its value; empty if none could be measured."""
    truth: dict[str, float]
    """Some of ``TRUTH`` -> mean over the true images that have such pixels; empty without true images."""
    true_views: int
    """Number of true images. A view whose camera lies inside an object has none."""

    def __post_init__(self) -> None:
        unknown = sorted(self.truth.keys() - set(TRUTH))
        if unknown:
            raise ValueError(f"truth holds {', '.join(unknown)}, expected {', '.join(TRUTH)} alone: evaluate again")


@dataclass(frozen=True, kw_only=True)
class NovelRecord:
    """The content of ``novel.json``."""

    format: int = version(NOVEL_FORMAT, "evaluate again with novel=...")
    command: str
    ramp: bool
    """Whether the shift grows from 0 at the first instant to its full value at the last, as in a change of lane."""
    real_views: int
    """Number of real images, those of the recorded views that are shifted."""
    absent: str | None
    """Why there are no distances, and what to do about it; None if there are some."""
    shifts: tuple[NovelShift, ...]


NOVEL = JsonFile("records/novel.json", NovelRecord)


PRESETS_FORMAT = 1
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

    format: int = version(PRESETS_FORMAT, "evaluate again with presets=...")
    command: str
    device: str
    threads: int
    views: int
    noise: Noise
    rendered: tuple[RenderedAs, ...]


PRESETS = JsonFile("records/presets.json", PresetRecord)
