"""The interface of everything that moves in the street."""

from typing import Protocol, runtime_checkable

from sparsestreet.data.synthetic.parts import Part


@runtime_checkable
class Model(Protocol):
    """An object in its box frame: x along the heading, y left, z up, origin at the box center."""

    @property
    def class_name(self) -> str: ...

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width, height of the box, meters."""
        ...

    def parts(self, traveled: float) -> list[Part]:
        """Returns the parts after ``traveled`` meters; wheels turn and legs walk with the distance."""
        ...
