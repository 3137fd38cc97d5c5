"""Tiles that an ellipse is listed in, by brute force (docs/stability.md; the number in a name is the row there)."""

import math

import numpy as np
import pytest
import torch

from sparsestreet.ops import SplatSettings, contribution
from sparsestreet.ops.cpu.library import FASTEST_VARIANT, idle_workspaces
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import (
    cast,
    device_of,
    every_precision,
    front_camera,
    one_gaussian,
    render,
)


def _card(mean: np.ndarray, sides: np.ndarray, turn: float, width: int, height: int) -> Gaussians:
    """A flat card parallel to the image, 1 m ahead of a camera of focal length 100: 100 px a meter."""
    x, y = (mean - np.array([width, height]) / 2) / 100
    return one_gaussian(
        means=[[x, y, 1.0]],
        scales=[[*(sides / 100), 0.0]],
        quaternions=[[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]],
    )


def _squared_distances(x: np.ndarray, y: np.ndarray, mean: np.ndarray, conic: np.ndarray) -> np.ndarray:
    """q, in standard deviations squared."""
    dx, dy = x - mean[0], y - mean[1]
    return conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy


def _nearest_of_tiles(mean: np.ndarray, conic: np.ndarray, width: int, height: int, cut: bool) -> np.ndarray:
    """Least q on the vertical lines through each tile's pixel centers, first to last center; ``cut`` at the image.

    A row of tiles is listed over the columns that the ellipse passes through between its first and its last centers, so
    this is what decides whether a tile is listed, not its pixel centers alone.
    """
    tiles_x, tiles_y = -(-width // 16), -(-height // 16)
    x, top = np.arange(width)[None] + 0.5, 16.0 * np.arange(tiles_y)[:, None] + 0.5
    bottom = np.minimum(top + 15, height - 0.5) if cut else top + 15
    best = mean[1] - conic[0, 1] / conic[1, 1] * (x - mean[0])
    q = _squared_distances(x, np.clip(best, top, bottom), mean, conic)
    return np.pad(q, ((0, 0), (0, tiles_x * 16 - width)), constant_values=np.inf).reshape(tiles_y, tiles_x, 16).min(2)


def _listed_tiles(backend: str, card: Gaussians, view: Camera, dtype: torch.dtype) -> int | None:
    """(splat, tile) pairs of the card's last rendering; None of a backend without tiles."""
    if backend == "cpu":
        mine = [workspace for workspace in idle_workspaces() if workspace.key == (dtype, FASTEST_VARIANT)]
        return mine[-1].pair_count()
    if backend == "triton":
        from sparsestreet.ops.triton.counters import count_work

        return count_work(cast(card, dtype, device=device_of(backend)), view, SplatSettings())[0]
    return None


@pytest.mark.slow_if_interpreted
@every_precision
@pytest.mark.parametrize(
    ("tiles", "longest"),
    [
        # The first ones reach further than the 8 tiles that a mask can hold.
        pytest.param((37, 11), [150.0, 60.0] + 4 * [40.0, 20.0, 10.0, 4.0], marks=pytest.mark.lengthy),
        ((5, 2), [20.0, 8.0]),
    ],
)
def test_23_tiles_of_ellipses_on_a_grid_that_is_not_square(backend, dtype, tiles, longest):
    """Ellipses of random place, turn and thickness: brute force over all pixels and tiles of the image."""
    # The last tiles are cut.
    width, height = tiles[0] * 16 - 5, tiles[1] * 16 - 3
    view, rng, clear_cases = front_camera(width, height, 100.0), np.random.default_rng(0), 0
    reach = 2 * math.log(0.8 * 255)
    y, x = np.mgrid[:height, :width] + 0.5
    for length in longest:
        mean = np.array([rng.uniform(0, width), rng.uniform(0, height)])
        turn, sides = rng.uniform(0, math.pi), np.array([length, rng.uniform(1, 10)])
        card = _card(mean, sides, turn, width, height)
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) * sides
        covariance = axes @ axes.T + 0.3 * np.eye(2)
        conic, thinnest = np.linalg.inv(covariance), math.sqrt(np.linalg.eigvalsh(covariance)[0])
        q = _squared_distances(x, y, mean, conic)
        # Where rounding may decide: an ellipse 1e-3 of a standard deviation wider or narrower.
        clear = abs(np.sqrt(q) - math.sqrt(reach)) > (1e-3 if dtype == torch.float32 else 1e-9)
        drawn = render(card, view, backend, dtype).images["alpha"].numpy() > 0
        np.testing.assert_array_equal(drawn[clear], (q <= reach)[clear])
        counted = contribution(cast(card, dtype, device=device_of(backend)), view, backend=backend)
        assert int(counted.pixels[0]) == drawn.sum()
        listed = _listed_tiles(backend, card, view, dtype)
        if listed is None:
            continue
        needed = (_nearest_of_tiles(mean, conic, width, height, cut=True) <= reach).sum()
        # Margins of 0.01 px and 1e-5 of the ellipse's half sides, along both axes, may list a tile more.
        margin = 2 * (0.01 + 1e-5 * math.sqrt(reach * covariance.trace())) / thinnest
        allowed = (_nearest_of_tiles(mean, conic, width, height, cut=False) <= (math.sqrt(reach) + margin) ** 2).sum()
        assert needed <= listed <= allowed
        clear_cases += needed == allowed
    assert clear_cases > 0.6 * len(longest) or listed is None
