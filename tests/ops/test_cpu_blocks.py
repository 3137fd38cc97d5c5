"""Blocks of a tile that the C++ pixel loops visit, and runs of rows that no tile has: no pixel and no row is lost, and
few blocks are visited in vain."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution
from sparsestreet.ops.cpu.library import idle_workspaces, load_library
from sparsestreet.ops.cpu.rasterizer import rasterize
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import cast, fill_buffers_with_nan, front_camera, one_gaussian, random_gaussians
from tests.ops.test_effects_shutter import rolling

WIDTH, HEIGHT = 53, 37  # the last tiles and blocks are cut
SHARP = SplatSettings(eps2d=0.0)  # so that needles stay thinner than a pixel
REACH = 2 * math.log(0.8 * 255)
"""Largest squared distance in standard deviations at which a splat of opacity 0.8 is drawn."""

every_variant = pytest.mark.parametrize(
    "variant",
    [
        pytest.param(v, marks=pytest.mark.skipif(load_library().splat_variant_name(v) is None, reason="does not run"))
        for v in range(3)
    ],
)


def ellipses(kind: str, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Means, px, and axes: columns of one standard deviation, px."""
    rng = np.random.default_rng(sum(kind.encode()))
    for _ in range(count):
        turn = rng.choice([0.0, math.pi / 2, *rng.uniform(0, math.pi, 6)])
        longest, thinnest = {
            "random": (20.0, 0.3),
            "needle": (60.0, 2e-3),
            "huge": (1e5, 1.0),
            "grazing": (30.0, 0.1),
        }[kind]
        sides = np.exp(rng.uniform(math.log(thinnest), math.log(longest), 2))
        if kind == "needle":
            sides = np.array([rng.uniform(5, longest), thinnest * rng.uniform(1, 50)])
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) * sides
        mean = rng.uniform((-10, -10), (WIDTH + 10, HEIGHT + 10))
        if kind == "grazing":
            # Its rim passes within 1e-6 of the center of a pixel in a corner of a block, mostly of a tile.
            step = rng.choice([2, 4, 16, 16])
            corner = step * rng.integers(1, (WIDTH // step + 1, HEIGHT // step + 1)) - rng.integers(0, 2, 2) + 0.5
            way = rng.normal(size=2)
            mean = corner + axes @ way / np.linalg.norm(way) * math.sqrt(REACH) * (1 + rng.choice([-1e-6, 1e-6, -1e-3]))
        yield mean, axes


def card(mean: np.ndarray, axes: np.ndarray) -> Gaussians:
    """A flat card 1 m ahead of the camera of focal length 100: 100 px a meter."""
    turn, sides = math.atan2(axes[1, 0], axes[0, 0]), np.linalg.norm(axes, axis=0)
    x, y = (mean - np.array([WIDTH, HEIGHT]) / 2) / 100
    return one_gaussian(
        means=[[x, y, 1.0]],
        scales=[[*(sides / 100), 0.0]],
        quaternions=[[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]],
    )


def drawn(rows: Gaussians, view: Camera, variant: int, every_tile: bool = False) -> tuple[list[torch.Tensor], int]:
    """Layers, and the samples that were evaluated."""
    offsets = rows.means.new_zeros(len(rows), 2)
    raster = rasterize(rows, offsets, view, SHARP, variant, every_tile)
    mine = [workspace for workspace in idle_workspaces() if workspace.key == (rows.means.dtype, variant)]
    return [raster.rgb, raster.transmittance, raster.depth_sum], mine[-1].sample_count()


def blocks_met(mean: np.ndarray, axes: np.ndarray, height: int) -> int:
    """Blocks, also those past the image, whose rectangle of pixel centers the ellipse comes near to."""
    conic = np.linalg.inv(axes @ axes.T)
    margin = 2 * (0.01 + 1e-5 * math.sqrt(REACH) * np.linalg.norm(axes, axis=1))
    left, top = np.meshgrid(np.arange(0, 64, 4) + 0.5 - mean[0], np.arange(0, 48, height) + 0.5 - mean[1])
    low = np.stack((left, top)) - margin[:, None, None]
    high = np.stack((left + 3, top + height - 1)) + margin[:, None, None]
    least = np.where(((low <= 0) & (high >= 0)).all(0), 0.0, np.inf)
    for axis in (0, 1):  # a side lies at a fixed coordinate `axis`; the other one is free
        for fixed in (low[axis], high[axis]):
            free = np.clip(-conic[0, 1] / conic[1 - axis, 1 - axis] * fixed, low[1 - axis], high[1 - axis])
            point = np.stack((fixed, free) if axis == 0 else (free, fixed))
            least = np.minimum(least, np.einsum("i...,ij,j...->...", point, conic, point))
    return int((least <= REACH * (1 + 1e-3)).sum())


@every_variant
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["random", "needle", "huge", "grazing"])
def test_no_pixel_is_lost_and_few_blocks_are_visited_in_vain(kind, dtype, variant):
    """The image is that of all blocks, to the bit; the blocks are at most those of an exact test with a margin."""
    view, height, seen = front_camera(WIDTH, HEIGHT, 100.0), 4 if variant == 2 else 2, 0
    for mean, axes in ellipses(kind, 60):
        rows = cast(card(mean, axes), dtype)
        (own, samples), (every, _) = (drawn(rows, view, variant, every_tile) for every_tile in (False, True))
        assert all(map(torch.equal, own, every)), (mean, axes)
        assert samples <= 4 * height * blocks_met(mean, axes, height), (mean, axes)
        seen += bool((own[1] < 1).any())
    assert seen > (12 if kind == "needle" else 30)  # needles may pass between the pixels


@every_variant
@pytest.mark.parametrize("direction", ["top", "left"])
def test_no_pixel_is_lost_through_a_shutter(direction, variant):
    view = rolling(front_camera(WIDTH, HEIGHT, 100.0), (0.2, -0.15, 0.05), (0.02, 0.04, 0.1), direction)
    for kind in ("random", "needle", "grazing"):
        rows = [cast(card(mean, axes), torch.float32) for mean, axes in ellipses(kind, 60)]
        for scene in (*rows, Gaussians.concatenate(rows)):
            (own, _), (every, _) = (drawn(scene, view, variant, every_tile) for every_tile in (False, True))
            assert all(map(torch.equal, own, every))


@pytest.mark.parametrize("kind", ["random", "needle", "grazing"])
def test_counters_lose_no_pixel(kind):
    view = front_camera(WIDTH, HEIGHT, 100.0)
    for mean, axes in ellipses(kind, 60):
        rows = cast(card(mean, axes), torch.float32)
        every, _ = drawn(rows, view, -1, every_tile=True)
        counted = contribution(rows, view, settings=SHARP, backend="cpu")
        assert int(counted.pixels[0]) == int((every[1] < 1).sum())
        assert float(counted.weight[0]) == pytest.approx(float((1 - every[1].double()).sum()), rel=1e-5)


@every_variant
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("first", [0, 1, 7])
def test_rows_that_are_not_seen_get_zeros_however_many_lie_together(first, dtype, variant, monkeypatch):
    """Runs of 1 to 200 rows behind the camera, from odd places on: their gradients go past the caches."""
    view = front_camera(WIDTH, HEIGHT, 40.0)
    gaussians = cast(random_gaussians(640, view, terms=16), dtype)
    hidden = torch.zeros(640, dtype=torch.bool)
    for start, count in ((first, 1), (first + 3, 6), (first + 20, 33), (first + 90, 200), (638 - first, 2)):
        hidden[start : start + count] = True
    fields = [
        getattr(gaussians, name).detach().clone() for name in ("means", "quaternions", "scales", "opacities", "sh")
    ]
    fields[0][hidden, 2] = -5.0
    alone = [field[~hidden] for field in fields]

    def gradients(given: list[torch.Tensor]) -> list[torch.Tensor]:
        leaves = [field.clone().requires_grad_() for field in given]
        offsets = torch.zeros(len(leaves[0]), 2, dtype=dtype, requires_grad=True)
        drawn = rasterize(Gaussians(*leaves), offsets, view, SplatSettings(), variant)
        return list(torch.autograd.grad(drawn.rgb.square().sum() + drawn.depth_sum.sum(), [*leaves, offsets]))

    there = gradients(alone)
    fill_buffers_with_nan(monkeypatch)
    for found, expected in zip(gradients(fields), there, strict=True):
        assert torch.equal(found[hidden], torch.zeros_like(found[hidden]))
        assert torch.equal(found[~hidden], expected)
