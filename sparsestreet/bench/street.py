"""A synthetic proxy for a trained street: splats of the same kinds in the same places, without training.

The camera is at the origin (x right, y down, z forward, meters), 1.6 m above the road. Splats lie on surfaces as in a
trained street: flat on the road and facades, thin and upright on poles and trunks, small on cars. A few large faint
ones float. Sizes grow with distance, because what one camera saw has about one size on its screen.
"""

import math

import torch
from torch import Tensor

from sparsestreet.types import Gaussians

_ROAD = 1.6
_NEAR, _FAR = 3.0, 70.0
_CARS = ((-3.6, 9.0), (3.4, 14.0), (-3.4, 22.0), (3.6, 30.0), (-0.4, 38.0), (3.4, 48.0))
"""Centers (x, z) of cars, each 1.8 x 1.5 x 4.2 m."""
_SHARES = {"road": 0.3, "facades": 0.4, "cars": 0.15, "poles": 0.1, "adrift": 0.05}


def proxy_street(rows: int, terms: int = 16, seed: int = 0) -> Gaussians:
    """``rows`` splats with ``terms`` spherical harmonics; float32, equal for the same seed."""
    draw = _Draw(seed, unit=0.9 / math.sqrt(max(1, rows)))
    counts = {name: int(share * rows) for name, share in _SHARES.items()}
    counts["facades"] += rows - sum(counts.values())
    parts = (
        _road(draw, counts["road"]),
        _facades(draw, counts["facades"]),
        _cars(draw, counts["cars"]),
        _poles(draw, counts["poles"]),
        _adrift(draw, counts["adrift"]),
    )
    means, scales, opacities, colors = (torch.cat(columns) for columns in zip(*parts, strict=True))
    sh = 0.05 * draw.normal(rows, terms, 3)
    sh[:, 0] = (colors - 0.5) * math.sqrt(4 * math.pi)
    # A small rotation about a random axis, because surfaces are rough.
    quaternions = torch.cat((torch.ones(rows, 1), 0.03 * draw.normal(rows, 3)), -1)
    return Gaussians(means, quaternions, scales, opacities, sh)


class _Draw:
    """Random numbers of one seed, and a ``unit`` of size, radians, with which the rows just close the surfaces."""

    def __init__(self, seed: int, unit: float) -> None:
        self._unit = unit
        self._generator = torch.Generator().manual_seed(seed)

    def between(self, low: float | int, high: float | int, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=self._generator)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator)

    def pick(self, choices: int, count: int) -> Tensor:
        return torch.randint(choices, (count,), generator=self._generator)

    def depth(self, count: int) -> Tensor:
        """Log-uniform depths: an equal number of splats per octave of distance fills the image evenly."""
        return torch.exp(self.between(math.log(_NEAR), math.log(_FAR), count))

    def sizes(self, depth: Tensor, x: float | int, y: float | int, z: float | int) -> Tensor:
        """Standard deviations: factor times unit times distance, log-normal by half an octave."""
        spread = torch.exp(0.35 * self.normal(len(depth), 3))
        return self._unit * depth[:, None] * spread * torch.tensor([x, y, z])

    def opacities(self, count: int) -> Tensor:
        """Opacities: two thirds are nearly opaque surface, one third faint filling."""
        solid = torch.rand(count, generator=self._generator) < 0.67
        return torch.where(solid, self.between(0.6, 0.99, count), self.between(0.02, 0.4, count))


_Part = tuple[Tensor, Tensor, Tensor, Tensor]


def _road(draw: _Draw, count: int) -> _Part:
    z, x = draw.depth(count), draw.between(-9, 9, count)
    gray = draw.between(0.2, 0.4, count, 1).expand(-1, 3)
    return torch.stack((x, torch.full_like(x, _ROAD), z), -1), draw.sizes(z, 1.5, 0.1, 6), draw.opacities(count), gray


def _facades(draw: _Draw, count: int) -> _Part:
    z, y = draw.depth(count), draw.between(-12, _ROAD, count)
    side = 2.0 * draw.pick(2, count) - 1
    color = draw.between(0.3, 0.8, 8, 3)[(z / 9).long()]  # a house every nine meters
    sizes = draw.sizes(z, 0.1, 1.2, 4)
    return torch.stack((9.5 * side, y, z), -1), sizes, draw.opacities(count), color


def _cars(draw: _Draw, count: int) -> _Part:
    """Splats on the sides of boxes: one coordinate of each is moved to the surface."""
    place, half = torch.tensor(_CARS), torch.tensor([0.9, 0.75, 2.1])
    chosen = draw.pick(len(_CARS), count)
    inside = draw.between(-1, 1, count, 3)
    axis = draw.pick(3, count)[:, None]
    inside = inside.scatter(1, axis, inside.gather(1, axis).sign())
    center = torch.stack((place[chosen, 0], torch.full((count,), _ROAD - 0.75), place[chosen, 1]), -1)
    means = center + inside * half
    color = draw.between(0.1, 0.9, len(_CARS), 3)[chosen]
    return means, draw.sizes(means[:, 2], 0.7, 0.7, 0.7), draw.opacities(count), color


def _poles(draw: _Draw, count: int) -> _Part:
    """Poles every eight meters at both curbs, of needles tens of pixels long and about one wide."""
    z = 5 + 8.0 * draw.pick(8, count)
    side = 2.0 * draw.pick(2, count) - 1
    means = torch.stack((6.5 * side, draw.between(-5, _ROAD, count), z), -1)
    dark = draw.between(0.05, 0.25, count, 1).expand(-1, 3)
    return means, draw.sizes(z, 0.2, 6, 0.2), draw.opacities(count), dark


def _adrift(draw: _Draw, count: int) -> _Part:
    z = draw.depth(count)
    means = torch.stack((z * draw.between(-0.6, 0.6, count), draw.between(-6, 1, count), z), -1)
    gray = draw.between(0.4, 0.7, count, 1).expand(-1, 3)
    return means, draw.sizes(z, 6, 6, 6), draw.between(0.01, 0.15, count), gray
