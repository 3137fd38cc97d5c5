"""A body at rest: its surface, its joints, and the weights by which joints move the surface."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class BodyTemplate:
    """A closed surface on the joints of ``geometry.skeleton``, in their frame: y up, x to the left, meters.

    Raises ValueError if the weights of a vertex do not sum to 1, or if only one of the two directions is given.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "t 3"]
    """Triangles, counterclockwise from outside."""
    joints: Float[Tensor, "24 3"]
    weights: Float[Tensor, "v 24"]
    """Weight of each joint for each vertex, >= 0."""
    shape_directions: Float[Tensor, "v 3 10"] | None = None
    """Displacement of the vertices per coefficient of a person's shape; None: bodies differ in height only."""
    joint_directions: Float[Tensor, "24 3 10"] | None = None
    """Displacement of the joints per coefficient."""

    def __post_init__(self) -> None:
        sums = self.weights.sum(1)
        if not bool(((sums - 1).abs() < 1e-4).all()):
            row = int((sums - 1).abs().argmax())
            raise ValueError(f"the weights of a vertex sum to 1, those of vertex {row} to {float(sums[row]):.4g}")
        if (self.shape_directions is None) != (self.joint_directions is None):
            raise ValueError("shape_directions and joint_directions come together: give both or neither")

    @property
    def height(self) -> float:
        """Height from the soles to the crown, meters."""
        return float(self.vertices[:, 1].amax() - self.vertices[:, 1].amin())

    def shaped(self, shape: Float[Tensor, "10"], height: float) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "24 3"]]:
        """Returns vertices and joints of one person, with the pelvis at the origin.

        A template with directions uses the coefficients of ``shape``; any other is scaled to ``height``.
        """
        if self.shape_directions is None or self.joint_directions is None:
            scale = height / self.height
            vertices, joints = scale * self.vertices, scale * self.joints
        else:
            vertices = self.vertices + self.shape_directions @ shape
            joints = self.joints + self.joint_directions @ shape
        return vertices - joints[0], joints - joints[0]

    def influences(self) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
        """Returns the joints that move each vertex, strongest first, and their weights; k is the most of any vertex."""
        most = int((self.weights > 0).sum(1).amax())
        parts, joints = self.weights.sort(dim=1, descending=True, stable=True)
        return joints[:, :most].contiguous(), parts[:, :most].contiguous()


class Body(ABC):
    """The source of a template, as a frozen dataclass that a scene file holds as settings."""

    @abstractmethod
    def load(self) -> BodyTemplate:
        """Returns the template. Raises OSError or ValueError for a file that cannot be read."""


def surface(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "t 3"]
) -> tuple[Float[Tensor, " v"], Float[Tensor, "v 3"]]:
    """Returns a third of the area of the triangles around each vertex, square meters, and its outward unit normal."""
    a, b, c = vertices[faces].unbind(1)
    # Its length is twice the area, so larger triangles count more for the normal.
    across = torch.linalg.cross(b - a, c - a)
    shares = across.norm(dim=1, keepdim=True) / 6
    per_corner = torch.cat((shares, across), 1).repeat_interleave(3, 0)
    at_vertices = torch.zeros(len(vertices), 4, dtype=vertices.dtype).index_add_(0, faces.flatten(), per_corner)
    return at_vertices[:, 0], torch.nn.functional.normalize(at_vertices[:, 1:], dim=1)
