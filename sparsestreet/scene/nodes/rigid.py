"""Objects that move without changing their shape."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.density import outside_boxes
from sparsestreet.scene.nodes.tracked import Tracked, TrackedSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


@dataclass(frozen=True, kw_only=True)
class RigidSettings(TrackedSettings):
    """``TrackedSettings`` with the distance by which a Gaussian may leave its box."""

    min_displacement: float | None = 1.0
    min_gaussians: int = 1000
    max_gaussians: int | None = 8000
    points_per_instance: int = 300
    box_margin: float = 0.1
    """Meters by which a row's center may lie outside its box; annotated boxes are about this tight."""

    @property
    def node_class(self) -> "type[Rigid]":
        return Rigid


class Rigid(Tracked):
    """Objects whose Gaussians keep their places in the box."""

    settings: RigidSettings

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Returns every instance's Gaussians at its pose; opacity is exactly 0 if the instance is absent."""
        return self.placed(view)

    def outside(self) -> Bool[Tensor, " n"]:
        """Returns whether each row's center left its box by more than ``box_margin``."""
        return outside_boxes(self.rows.means, self.rows.instances, self.sizes, margin=self.settings.box_margin)
