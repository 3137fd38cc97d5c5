"""How points are found in images."""

from dataclasses import dataclass, field

import torch

ENLARGEMENT = 1.1
"""Factor of a moving object's box, for points just outside an imprecise box."""


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """How depths far ahead are found, and what they are for. Raises ValueError for impossible settings."""

    nearest: float = 20.0
    """Meters along the optical axis, from which on points count: nearer things are the lidar's."""
    farthest: float = 180.0
    """Meters; what fits a plane this far away best, such as a cloud, has no depth."""
    step: float = 2.5
    """Meters of travel from one swept view to the next."""
    width: int = 320
    """Columns of the compared images, at most; wider ones are reduced, and the work with them."""
    min_score: float = 0.75
    """Least normalized cross-correlation, in [-1, 1], mean over the two images that agree best."""
    spacing: float = 1.0
    """Side of a cube, meters, of whose points one becomes a start of Gaussians."""
    depth_weight: float = 0.4
    """Of the error of the depth in swept views, |log rendered - log swept|, mean over their pixels; 0: no term."""

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ValueError(f"a sweep needs 0 < nearest < farthest, got {self.nearest} and {self.farthest} m")
        if not (self.step > 0 and self.spacing > 0):
            raise ValueError(f"a sweep needs step and spacing above 0 m, got {self.step} and {self.spacing}")
        if self.width < 8:
            raise ValueError(f"a sweep needs images of at least 8 columns, got width {self.width}")
        if not -1 <= self.min_score < 1:
            raise ValueError(f"min_score must lie in [-1, 1), got {self.min_score}: it is a correlation")
        if not self.depth_weight >= 0:
            raise ValueError(f"depth_weight must be >= 0, got {self.depth_weight}: 0 leaves the term out")


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
    sweep: SweepSettings | None = field(default_factory=SweepSettings)
    """How depths far ahead are found, which few features have; None: not at all."""
    threads: int | None = None
    """That work at once; None: as many as this process has for its tensors (torch's), by default one a core."""

    def __post_init__(self) -> None:
        for name in ("features", "threads"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"points from images need {name} of at least 1, got {getattr(self, name)}")
        if self.min_views < 2:
            raise ValueError(f"a point must be seen in at least 2 views to be triangulated, got {self.min_views}")

    @property
    def workers(self) -> int:
        """How many threads work."""
        return self.threads or torch.get_num_threads()
