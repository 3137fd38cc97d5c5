"""The five scenes on which accuracy is weighed against time."""

import math
from dataclasses import dataclass, replace

import torch

from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.street import proxy_street
from sparsestreet.types import Camera, Gaussians

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


def bench_scenes(size: Size, street: BenchScene | None = None, seed: int = 0) -> list[BenchScene]:
    """All five scenes, equal for the same seed; without a trained ``street`` a proxy scene takes its place."""
    camera = frustum_camera(size.width, size.height)
    if street is None:
        street = BenchScene("street", "proxy scene made of numbers, not trained", proxy_street(size.rows), camera)
    frustum = frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16, seed=seed)
    return [
        BenchScene("random frustum", "uniform in the frustum, median sigma 2 px", frustum, camera),
        deep_stack(size, seed),
        needles_and_giants(size, seed),
        street,
        half_masked(street, seed),
    ]


def deep_stack(size: Size, seed: int = 0) -> BenchScene:
    """Faint splats, STACK of them on a pixel in the middle of the image (fewer at its edges).

    A splat of opacity o reaches alpha_min = 1/255 on an area of 2 pi sigma^2 ln(255 o); rows x area = STACK x image.
    """
    camera = frustum_camera(size.width, size.height)
    rows = frustum_gaussians(size.rows, camera, sigma_pixels=1.0, terms=16, seed=seed)
    opacities = 0.01 + 0.04 * torch.rand(size.rows, generator=torch.Generator().manual_seed(seed))
    reach = float((255 * opacities).log().mean())
    sigma = math.sqrt(STACK * size.width * size.height / (size.rows * 2 * math.pi * reach))
    # Not round, because the rotation of a round splat has no gradient to compare.
    scales = sigma * rows.means[:, 2:] / size.width * torch.tensor([0.7, 1.0, 1 / 0.7])
    stacked = replace(rows, scales=scales, opacities=opacities)
    return BenchScene("deep stack", f"{STACK} faint splats over a pixel, sigma {sigma:.1f} px", stacked, camera)


def needles_and_giants(size: Size, seed: int = 0) -> BenchScene:
    """Half needles (0.1 to 1 px by 20 to 200 px), 1/20 giants (a tenth to half the image), the rest ordinary."""
    camera = frustum_camera(size.width, size.height)
    rows = frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16, seed=seed)
    generator = torch.Generator().manual_seed(seed)

    def log_uniform(low: float | int, high: float | int, columns: int) -> torch.Tensor:
        draw = torch.rand(size.rows, columns, generator=generator)
        return low * (high / low) ** draw

    pixel = rows.means[:, 2:] / size.width
    needle = torch.cat((log_uniform(20, 200, 1), log_uniform(0.1, 1, 2)), -1) * pixel
    giant = log_uniform(0.1 * size.width, 0.5 * size.width, 3) * pixel
    kind = torch.rand(size.rows, 1, generator=generator)
    scales = torch.where(kind < 0.5, needle, torch.where(kind < 0.55, giant, rows.scales))
    faint = torch.where(kind[:, 0] < 0.55, 0.2 * rows.opacities, rows.opacities)
    odd = replace(rows, scales=scales, opacities=faint)
    return BenchScene("needles and giants", "half needles up to 200 px, a twentieth giants", odd, camera)


def half_masked(street: BenchScene, seed: int = 0) -> BenchScene:
    """The street with a random half of its rows at opacity 0, as mask training leaves them before they are removed."""
    kept = torch.rand(len(street.gaussians), generator=torch.Generator().manual_seed(seed)) < 0.5
    opacities = torch.where(kept, street.gaussians.opacities, 0.0)
    masked = replace(street.gaussians, opacities=opacities)
    return BenchScene(f"{street.name}, half masked", street.source, masked, street.camera)
