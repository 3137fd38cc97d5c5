"""How points are found in images."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class ImagePointSettings:
    """How points are found in images. Pixels are those of the training images."""

    features: int = 2000
    """Most features of one image."""
    epipolar_tolerance: float = 0.8
    """Largest distance of a match from the epipolar line, pixels."""
    ratio: float = 0.8
    """Largest ratio of the distances to the best match and to the second-best elsewhere on the line (Lowe)."""
    max_error: float = 0.6
    """Largest reprojection error, pixels; a view with a larger one does not count."""
    min_views: int = 3
    """Least number of views of a point."""
    min_support: float = 0.6
    """Of the compared views whose image contains a point, the least share that must show it.

    Windows of a house repeat, but only the right match is seen from all views."""
    max_depth_error: float = 0.03
    """Largest standard deviation of a point's position divided by its distance, from parallax and feature noise."""
    threads: int = 2
    cache: Path | str | None = None
    """Folder for computed points; None: every run computes them anew."""

    def __post_init__(self) -> None:
        for name in ("features", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"points from images need {name} of at least 1, got {getattr(self, name)}")
        if self.min_views < 2:
            raise ValueError(f"a point must be seen in at least 2 views to be triangulated, got {self.min_views}")
