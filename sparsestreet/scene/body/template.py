"""A body at rest: its surface, its joints, and which joints move which part of the surface."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class BodyTemplate:
    """A closed surface on the joints of ``geometry.skeleton``, in their frame: y up, x to the left, meters.

    Raises ValueError where the weights of a vertex do not sum to 1, or only one of the two directions is given.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "t 3"]
    """Triangles, counterclockwise from outside."""
    joints: Float[Tensor, "24 3"]
    weights: Float[Tensor, "v 24"]
    """Part of each joint in what moves a vertex, >= 0."""
    shape_directions: Float[Tensor, "v 3 10"] | None = None
    """How each coefficient of a person's shape moves the vertices; None: only the height is known to differ."""
    joint_directions: Float[Tensor, "24 3 10"] | None = None
    """How it moves the joints."""

    def __post_init__(self) -> None:
        sums = self.weights.sum(1)
        if not bool(((sums - 1).abs() < 1e-4).all()):
            row = int((sums - 1).abs().argmax())
            raise ValueError(f"the weights of a vertex sum to 1, those of vertex {row} to {float(sums[row]):.4g}")
        if (self.shape_directions is None) != (self.joint_directions is None):
            raise ValueError("shape_directions and joint_directions come together: give both or neither")

    @property
    def height(self) -> float:
        """Meters from the soles to the crown."""
        return float(self.vertices[:, 1].amax() - self.vertices[:, 1].amin())

    def shaped(self, shape: Float[Tensor, "10"], height: float) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "24 3"]]:
        """Vertices and joints of one person, the pelvis at the origin.

        A template with directions takes the coefficients of the ``shape``, any other is scaled to the ``height``.
        """
        if self.shape_directions is None or self.joint_directions is None:
            scale = height / self.height
            vertices, joints = scale * self.vertices, scale * self.joints
        else:
            vertices = self.vertices + self.shape_directions @ shape
            joints = self.joints + self.joint_directions @ shape
        return vertices - joints[0], joints - joints[0]

    def influences(self) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
        """The joints that move each vertex, the strongest first, and their parts; k as many as any vertex has."""
        most = int((self.weights > 0).sum(1).amax())
        parts, joints = self.weights.sort(dim=1, descending=True, stable=True)
        return joints[:, :most].contiguous(), parts[:, :most].contiguous()


class Body(ABC):
    """Where a template comes from; a frozen dataclass, which a scene file holds as settings."""

    @abstractmethod
    def load(self) -> BodyTemplate:
        """The template. Raises OSError or ValueError where it comes from a file that cannot be read."""


def surface(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "t 3"]
) -> tuple[Float[Tensor, " v"], Float[Tensor, "v 3"]]:
    """A third of the area of the triangles around each vertex, square meters, and its unit normal, outwards."""
    a, b, c = vertices[faces].unbind(1)
    # Twice the area long, so larger triangles count more for the normal.
    across = torch.linalg.cross(b - a, c - a)
    shares = across.norm(dim=1, keepdim=True) / 6
    per_corner = torch.cat((shares, across), 1).repeat_interleave(3, 0)
    at_vertices = torch.zeros(len(vertices), 4, dtype=vertices.dtype).index_add_(0, faces.flatten(), per_corner)
    return at_vertices[:, 0], torch.nn.functional.normalize(at_vertices[:, 1:], dim=1)
