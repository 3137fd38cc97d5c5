"""Everything that does not move."""

from sparsestreet.scene.nodes.node import Node
from sparsestreet.types import Gaussians


class Background(Node):
    """Static Gaussians; their rows are in the world frame already."""

    def gaussians_at(self, time: float, sh_degree: int) -> Gaussians:
        """The same Gaussians at every time, activated, with the mask applied."""
        return self.activated(sh_degree)
