"""The scenes of the benchmarks: splats in a frustum, a proxy street, hard cases; each also with lens or shutter."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sparsestreet.types import Camera, Gaussians, Shutter


def frustum_camera(width: int, height: int) -> Camera:
    """A camera at the origin that looks along +z, 53 degrees wide."""
    intrinsics = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.eye(4), intrinsics, width, height)


def frustum_gaussians(rows: int, camera: Camera, sigma_pixels: float, terms: int) -> Gaussians:
    """Gaussians of depth 2 to 50 m, log-normal sizes of this median on the screen, opacity 0.05 to 0.95; float32."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    focal = float(camera.intrinsics[0, 0])
    depth = 2 + 48 * uniform(rows)
    pixels = uniform(rows, 2) * torch.tensor([camera.width, camera.height])
    centered = (pixels - torch.tensor([camera.width / 2, camera.height / 2])) / focal
    sizes = sigma_pixels * torch.exp(0.5 * torch.randn(rows, 3, generator=generator))
    return Gaussians(
        torch.cat((centered * depth[:, None], depth[:, None]), -1),
        torch.randn(rows, 4, generator=generator),
        sizes * depth[:, None] / focal,
        0.05 + 0.9 * uniform(rows),
        0.3 * torch.randn(rows, terms, 3, generator=generator),
    )


_ROAD = 1.6
_NEAR, _FAR = 3.0, 70.0
_CARS = ((-3.6, 9.0), (3.4, 14.0), (-3.4, 22.0), (3.6, 30.0), (-0.4, 38.0), (3.4, 48.0))
"""Centers (x, z) of cars, each 1.8 x 1.5 x 4.2 m."""
_SHARES = {"road": 0.3, "facades": 0.4, "cars": 0.15, "poles": 0.1, "adrift": 0.05}


def proxy_street(rows: int, terms: int = 16) -> Gaussians:
    """``rows`` splats with ``terms`` spherical harmonics; float32, the same every time."""
    draw = _Draw(unit=0.9 / math.sqrt(max(1, rows)))
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
    """Random numbers, and a ``unit`` of size, radians, with which the rows just close the surfaces."""

    def __init__(self, unit: float) -> None:
        self._unit = unit
        self._generator = torch.Generator().manual_seed(0)

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
    """Splat on the sides of boxes: one coordinate of each is moved to the surface."""
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


STACK = 400
"""Splats over a pixel in the deep stack."""


@dataclass(frozen=True)
class Size:
    """Image and number of splats."""

    width: int
    height: int
    rows: int


@dataclass(frozen=True)
class BenchScene:
    """One view of float32 Gaussians."""

    name: str
    source: str
    """What the scene is made of, and whether it was trained."""
    gaussians: Gaussians
    camera: Camera


def bench_scenes(size: Size, street: BenchScene | None = None) -> list[BenchScene]:
    """All five scenes, the same every time; without a trained ``street`` a proxy scene takes its place."""
    camera = frustum_camera(size.width, size.height)
    if street is None:
        street = BenchScene("street", "proxy scene made of numbers, not trained", proxy_street(size.rows), camera)
    frustum = frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16)
    return [
        BenchScene("random frustum", "uniform in the frustum, median sigma 2 px", frustum, camera),
        deep_stack(size),
        needles_and_giants(size),
        street,
        half_masked(street),
    ]


def deep_stack(size: Size) -> BenchScene:
    """Faint splats, STACK of them on a pixel in the middle of the image (fewer at its edges).

    A splat of opacity o reaches alpha_min = 1/255 on an area of 2 pi sigma^2 ln(255 o); rows x area = STACK x image.
    """
    camera = frustum_camera(size.width, size.height)
    rows = frustum_gaussians(size.rows, camera, sigma_pixels=1.0, terms=16)
    opacities = 0.01 + 0.04 * torch.rand(size.rows, generator=torch.Generator().manual_seed(0))
    reach = float((255 * opacities).log().mean())
    sigma = math.sqrt(STACK * size.width * size.height / (size.rows * 2 * math.pi * reach))
    # Not round, because the rotation of a round splat has no gradient to compare.
    scales = sigma * rows.means[:, 2:] / size.width * torch.tensor([0.7, 1.0, 1 / 0.7])
    stacked = replace(rows, scales=scales, opacities=opacities)
    return BenchScene("deep stack", f"{STACK} faint splats over a pixel, sigma {sigma:.1f} px", stacked, camera)


def needles_and_giants(size: Size) -> BenchScene:
    """Half needles (0.1 to 1 px by 20 to 200 px), 1/20 giants (a tenth to half the image), the rest ordinary."""
    camera = frustum_camera(size.width, size.height)
    rows = frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16)
    generator = torch.Generator().manual_seed(0)

    def log_uniform(low: float | int, high: float | int, columns: int) -> torch.Tensor:
        return low * (high / low) ** torch.rand(size.rows, columns, generator=generator)

    pixel = rows.means[:, 2:] / size.width
    needle = torch.cat((log_uniform(20, 200, 1), log_uniform(0.1, 1, 2)), -1) * pixel
    giant = log_uniform(0.1 * size.width, 0.5 * size.width, 3) * pixel
    kind = torch.rand(size.rows, 1, generator=generator)
    scales = torch.where(kind < 0.5, needle, torch.where(kind < 0.55, giant, rows.scales))
    faint = torch.where(kind[:, 0] < 0.55, 0.2 * rows.opacities, rows.opacities)
    odd = replace(rows, scales=scales, opacities=faint)
    return BenchScene("needles and giants", "half needles up to 200 px, a twentieth giants", odd, camera)


def half_masked(street: BenchScene) -> BenchScene:
    """The street with a random half of its rows at opacity 0, as mask training leaves them before they are removed."""
    kept = torch.rand(len(street.gaussians), generator=torch.Generator().manual_seed(0)) < 0.5
    opacities = torch.where(kept, street.gaussians.opacities, 0.0)
    masked = replace(street.gaussians, opacities=opacities)
    return BenchScene(f"{street.name}, half masked", street.source, masked, street.camera)


EffectsName = Literal["off", "lens", "shutter", "lens and shutter"]
EFFECTS: tuple[EffectsName, ...] = ("off", "lens", "shutter", "lens and shutter")
DISTORTION = (-0.05, 0.01, 5e-4, -5e-4, 0.0)
"""k1, k2, p1, p2, k3: a point 27 degrees off the axis moves inwards by 1.2 % of its distance from the center."""
TRANSLATION, ROTATION = (0.0, 0.0, 0.3), (0.0, 0.01, 0.0)
"""A readout of 30 ms in a car at 10 m/s that turns by 20 degrees a second: meters and radians, camera frame."""
WALK = 0.05
"""Standard deviation of each coordinate of the rows' own motion during the readout, meters: a brisk walk."""


def seen_through(scene: BenchScene, effects: EffectsName | None) -> BenchScene:
    """The scene with these effects instead of its camera's own; None: unchanged. Every call gives the same."""
    if effects is None:
        return scene
    like = scene.camera.intrinsics
    distortion = like.new_tensor(DISTORTION) if "lens" in effects else None
    shutter = Shutter(like.new_tensor(TRANSLATION), like.new_tensor(ROTATION)) if "shutter" in effects else None
    camera = replace(scene.camera, distortion=distortion, shutter=shutter)
    means = scene.gaussians.means
    walked = WALK * torch.randn(means.shape, generator=torch.Generator().manual_seed(0)).to(means)
    gaussians = replace(scene.gaussians, displacements=None if shutter is None else walked)
    return replace(scene, gaussians=gaussians, camera=camera)
