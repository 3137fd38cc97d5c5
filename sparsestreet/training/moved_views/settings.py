"""How views beside the recorded path are trained on."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class MovedViews:
    """Settings of the terms of moved views. Raises ValueError for impossible ones.

    Both terms are sums over the pixels whose content is known, divided by all pixels of the view: the less the lidar
    sees, the less they weigh.
    """

    every: int = 4
    """Steps from one moved view to the next."""
    start: float = 0.1
    stop: float = 0.9
    """Fractions of the run between which views are moved. The rest before the end belongs to the recorded views."""
    sideways: float = 4.0
    """Meters; a camera moves by a uniformly drawn distance up to this to the left or right, but into no wall."""
    divisor: int = 2
    """Sides of a moved view are those of the recorded one divided by this."""
    depth_weight: float = 4.0
    """Of the absolute error of the inverse depth, 1/m."""
    color_weight: float = 4.0
    """Of the absolute error of the color, mean over its channels."""
    sweeps: int = 10
    """How many frames before and after its own a view sees returns of."""
    returns_per_sweep: int = 30_000
    """A sweep keeps at most this number of returns, drawn at random: memory."""
    returns_per_view: int = 30_000
    """A view looks at no more returns, drawn at random in each step: time."""
    tolerance: float = 0.1
    """Difference between the color of a return and an image of another instant at which the return weighs 1/e."""

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("every", "divisor", "returns_per_sweep", "returns_per_view")}
        if wrong := {name: value for name, value in counts.items() if value < 1}:
            raise ValueError(f"moved views count from 1, got {wrong}: moved_views=none leaves them out")
        positive = {name: getattr(self, name) for name in ("sideways", "tolerance")}
        if wrong := {name: value for name, value in positive.items() if not value > 0}:
            raise ValueError(
                f"moved views need lengths and tolerances above 0, got {wrong}: moved_views=none leaves them out"
            )
        least = {name: getattr(self, name) for name in ("depth_weight", "color_weight", "sweeps")}
        if wrong := {name: value for name, value in least.items() if not value >= 0}:
            raise ValueError(f"moved views need weights and numbers of sweeps of at least 0, got {wrong}")
        if not 0 <= self.start <= self.stop <= 1:
            raise ValueError(f"moved views need 0 <= start <= stop <= 1, got {self.start} and {self.stop}")
