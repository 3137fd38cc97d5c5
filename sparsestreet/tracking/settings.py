"""Thresholds of the search for what moves."""

from dataclasses import dataclass, fields


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """When returns move, what belongs together, and what counts as an object. Lengths are meters.

    Raises ValueError for a value that is not positive, a share above 1, and a band of heights that holds nothing.
    """

    lowest: float = 0.25
    """Least height above the ground of a return that may be on an object."""
    highest: float = 4.0
    """Greatest one."""
    voxel: float = 0.25
    """Side of the cells at which the search asks whether rays pass."""
    reach: float = 0.3
    """A cell is occupied in a scan with a return this near to its own ones."""
    azimuth_bin: float = 0.6
    """Degrees of a bin of a scan's range image; about the angle between its rays, or more."""
    elevation_bin: float = 0.5
    """The same, up and down."""
    behind: float = 0.5
    """A ray passes a cell if it ends this far behind it, or farther."""
    behind_share: float = 0.02
    """The same as a share of the cell's distance; the larger one counts."""
    min_free: int = 3
    """Least number of scans that see through the place of a return that moves."""
    min_free_share: float = 0.4
    """Of the scans that see through it or find it occupied, the least share that see through it."""
    cluster_gap: float = 0.5
    """Returns of one object have a neighbor this near in plan."""
    cluster_gap_share: float = 0.012
    """Share of the distance to the lidar that is added to it, because far returns are sparse."""
    max_speed: float = 30.0
    """Meters per second."""
    max_lost: float = 2.0
    """Seconds for which an object may be hidden and still be the same."""
    min_frames: int = 5
    """Least number of frames in which an object is seen."""
    min_moved: float = 1.0
    """Least distance between two places of an object."""
    min_moved_few: float = 2.0
    """The same for an object with less than 10 returns a frame, which noise moves farther."""
    min_moving_share: float = 0.3
    """Of the returns in the boxes of an object, the least share that move: fewer do where leaves rustle."""

    min_confidence: float = 0.2
    """Least confidence, which is the product of the share of steps at which an object is seen, of the share of its
    returns that move, and of n / (n + 2) with n returns a step."""

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            if not getattr(self, name) > 0:
                raise ValueError(f"tracks found in lidar need a positive {name}, got {getattr(self, name)}")
        for name in ("min_free_share", "min_moving_share", "min_confidence", "behind_share", "cluster_gap_share"):
            if getattr(self, name) > 1:
                raise ValueError(f"tracks found in lidar need a {name} of at most 1, got {getattr(self, name)}")
        if self.highest <= self.lowest:
            raise ValueError(
                f"tracks found in lidar need returns between lowest and highest, got {self.lowest} and {self.highest}: "
                "raise highest"
            )
