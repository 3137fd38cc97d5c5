"""What moves the vertices of people: joints, weights and keyframes."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.scene.body.people import People
from sparsestreet.scene.body.template import BodyTemplate


@dataclass(frozen=True)
class Anatomy:
    """The data that move v vertices of i people, with k keyframes each."""

    vertices: Float[Tensor, "v 3"]
    """Vertices of the template at rest, which define neighbors."""
    attached: Int[Tensor, "v m"]
    """Joints that move each vertex."""
    weights: Float[Tensor, "v m"]
    joints: Float[Tensor, "i 24 3"]
    """Joints at rest, relative to the pelvis, meters."""
    keyframes: Float[Tensor, "i k 23 4"]
    """Rotations of all joints but the pelvis, relative to their parents."""

    @staticmethod
    def of(template: BodyTemplate, people: People) -> "Anatomy":
        return Anatomy(template.vertices, *template.influences(), people.joints, people.rotations)
