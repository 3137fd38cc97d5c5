"""``records/novel.json``: the quality of a scene's renders next to the recorded path."""

from dataclasses import dataclass

from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import version

FORMAT = 2
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

    format: int = version(FORMAT, "evaluate again with novel=...")
    command: str
    ramp: bool
    """Whether the shift grows from 0 at the first instant to its full value at the last, as in a change of lane."""
    real_views: int
    """Number of real images, those of the recorded views that are shifted."""
    absent: str | None
    """Why there are no distances, and what to do about it; None if there are some."""
    shifts: tuple[NovelShift, ...]


NOVEL = JsonFile("records/novel.json", NovelRecord)
