"""What all lens models have, and directions in polar coordinates."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

RIGHT_ANGLE = math.pi / 2
_ANGLES = 1441
"""Of the polar grid on which folds are looked for: an eighth of a degree between them."""
_AZIMUTHS = 49


@dataclass(frozen=True)
class Lens(ABC):
    """A calibrated lens. Raises ValueError for numbers that are not finite, or focal lengths that are not positive."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(map(math.isfinite, numbers)):
                raise ValueError(f"{entry.name} of a lens must be finite, got {value}")
        focal = self.pinhole.diagonal()[:2]
        if not (focal > 0).all():
            raise ValueError(f"the focal lengths of a lens must be positive at its center, got {focal.tolist()}")

    @property
    @abstractmethod
    def pinhole(self) -> Float64[Tensor, "3 3"]:
        """Intrinsics of the pinhole that shows the center of the image at the same resolution."""

    @property
    def widest(self) -> float:
        """Largest angle from the optical axis, radians, that the model is made for."""
        return math.pi

    @abstractmethod
    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        """Pixels by the formula alone, wherever it leads; NaN where it has no value."""

    def brown_conrady(self) -> Float64[Tensor, "5"] | None:
        """k1, k2, p1, p2, k3 with which the splat op simulates the lens around ``pinhole``; None: it cannot."""
        return None

    def project(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        """Pixels, inside of the image or not; NaN for directions beyond ``reach``.

        >>> from sparsestreet.geometry.lenses import Fisheye
        >>> rays = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
        >>> Fisheye(fx=100.0, fy=100.0, cx=50.0, cy=50.0).project(rays)[:, 0].round(decimals=2).tolist()
        [50.0, 207.08]
        """
        seen = angles_from_axis(directions) <= self.reach
        return torch.where(seen[..., None], self.image(directions), torch.nan)

    @cached_property
    def reach(self) -> float:
        """Angle from the optical axis, radians, within which no pixel shows two directions: ``widest``, or at most a
        quarter of a degree before the image of a polar grid is turned over."""
        angles = torch.linspace(0, self.widest, _ANGLES, dtype=torch.float64)
        azimuths = torch.linspace(0, 2 * math.pi, _AZIMUTHS, dtype=torch.float64)
        at = self.image(_polar(angles[:, None], azimuths[None]))
        out, across = at[1:, 1:] - at[:-1, :-1], at[:-1, 1:] - at[1:, :-1]
        # Twice the signed area of each cell, as the cross product of its diagonals. A NaN compares false.
        outwards = (out[..., 0] * across[..., 1] - out[..., 1] * across[..., 0] > 0).all(1)
        folded = torch.nonzero(~outwards).flatten()
        # The fold itself may lie in the cell before, if that one grew more than it shrank.
        return self.widest if not len(folded) else float(angles[max(int(folded[0]) - 1, 0)])

    def check(self, width: int, height: int) -> None:
        """Raises ValueError for a lens that folds back inside of its image, less than 90 degrees from its axis.

        A pinhole sees no farther than that. Images of circular fisheyes have corners that show nothing.
        """
        if self.reach >= min(RIGHT_ANGLE, self.widest):
            return
        azimuths = torch.linspace(0, 2 * math.pi, _AZIMUTHS, dtype=torch.float64)
        column, row = self.image(_polar(torch.tensor(self.reach, dtype=torch.float64), azimuths)).unbind(-1)
        if ((column > 0) & (column < width) & (row > 0) & (row < height)).any():
            raise ValueError(
                f"a lens must image each direction at a pixel of its own, but this {type(self).__name__} folds back "
                f"{math.degrees(self.reach):.1f} degrees from its axis, inside of the {width}x{height} image: check "
                "its coefficients and their order against the calibration"
            )


def angles_from_axis(directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b"]:
    """Radians between directions and the optical axis, 0 to pi.

    >>> angles_from_axis(torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)).item()
    1.5707963267948966
    """
    return torch.atan2(torch.hypot(directions[..., 0], directions[..., 1]), directions[..., 2])


def sides(directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
    """Unit vectors in the image from the center towards each direction; zero on the axis."""
    return torch.nn.functional.normalize(directions[..., :2], dim=-1, eps=1e-300)


def _polar(angles: Float64[Tensor, "*#b"], azimuths: Float64[Tensor, "*#b"]) -> Float64[Tensor, "*#b 3"]:
    """Unit directions at these angles from the axis."""
    sine, cosine = torch.sin(angles), torch.cos(angles)
    rays = (sine * torch.cos(azimuths), sine * torch.sin(azimuths), cosine)
    return torch.stack(torch.broadcast_tensors(*rays), -1)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64[Tensor, "3 3"]:
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
