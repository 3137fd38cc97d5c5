"""How points are found in images."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class ImagePointSettings:
    """How points are found in images; pixels are those of the images as they are trained on."""

    features: int = 2000
    """Of one image, at most."""
    epipolar_tolerance: float = 0.8
    """Pixels between a match and the epipolar line."""
    ratio: float = 0.8
    """Lowe's ratio of distances to the best match and the next one elsewhere on the line."""
    max_error: float = 0.6
    """Pixels; a view in which a point is farther from its feature does not count."""
    min_views: int = 3
    """Views that a point must be seen in."""
    min_support: float = 0.6
    """Share of the compared views in whose image a point lies that must show it: windows repeat, and only the right
    one is there from everywhere."""
    max_depth_error: float = 0.03
    """Standard deviation of a point's position over its distance, by its parallax and the noise of features."""
    threads: int = 2
    cache: Path | str | None = None
    """Folder in which points are kept; None: they are made anew by every run."""

    def __post_init__(self) -> None:
        for name in ("features", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"points from images need {name} of at least 1, got {getattr(self, name)}")
        if self.min_views < 2:
            raise ValueError(f"a point must be seen in at least 2 views to be triangulated, got {self.min_views}")
