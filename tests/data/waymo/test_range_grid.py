"""Rays of a range image: a sensor's own are found, and points move to the nearest of others."""

import numpy as np
import pytest
import torch

from sparsestreet.data.waymo.lidar import world_points
from sparsestreet.data.waymo.range_grid import RangeGrid
from sparsestreet.data.waymo.segment import LidarCalibration, Returns


def cloud(seed: int, beams: np.ndarray, columns: np.ndarray, *, low: float = 3, high: float = 60) -> np.ndarray:
    """A return of each beam and column, in float32 as a log has it."""
    azimuth, inclination = np.meshgrid(columns, beams)
    ranges = np.random.default_rng(seed).uniform(low, high, azimuth.shape)
    flat = np.cos(inclination)
    rays = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(inclination)), -1)
    return (ranges[..., None] * rays).reshape(-1, 3).astype(np.float32).astype(float)


def read(grid: RangeGrid, ranges: np.ndarray) -> np.ndarray:
    """The points that a reader finds."""
    pixels = np.flatnonzero(ranges > 0)
    angles = tuple(grid.inclinations.tolist())
    lidar = LidarCalibration(torch.eye(4, dtype=torch.float64), angles, (angles[0], angles[-1]))
    returns = Returns("TOP", ranges.shape, pixels, ranges.ravel()[pixels])
    return world_points(returns, lidar, torch.eye(4, dtype=torch.float64))


def turns(count: int) -> np.ndarray:
    return np.pi * (1 - (2 * np.arange(count) + 1) / count)


def test_an_even_sensor_is_found_and_its_points_stay():
    beams, columns = np.radians([-20.0, -7, -5, -4.5, 2]), turns(331)
    sweeps = [cloud(seed, beams, columns) for seed in range(2)]
    grid = RangeGrid.fitting(sweeps, 64, 1024)
    # Unevenly spread beams; a multiple of the columns would do as well, the fewest are taken.
    np.testing.assert_allclose(grid.inclinations, beams, atol=1e-6)
    assert grid.columns == 331
    placed = grid.place(sweeps[0])
    assert placed.lost == 0
    assert placed.moved.max() < 60 * 1e-6
    points = read(grid, placed.ranges[0])
    # Pixels are ordered from the highest beam, by columns.
    expected = sweeps[0].reshape(5, 331, 3)[::-1].reshape(-1, 3)
    np.testing.assert_allclose(points, expected, atol=60 * 2e-6)
    assert (placed.ranges[1] == -1).all()


def test_other_points_move_by_half_a_step_at_most():
    generator = np.random.default_rng(5)
    points = cloud(0, generator.uniform(-0.3, 0.1, 40), generator.uniform(-np.pi, np.pi, 50))
    grid = RangeGrid.fitting([points], 16, 300)
    assert (len(grid.inclinations), grid.columns) == (16, 300)
    placed = grid.place(points)
    found = np.concatenate([read(grid, image) for image in placed.ranges])
    assert len(found) == len(placed.moved) == len(points) - placed.lost
    # 40 beams in 16 groups: none is wider than 0.4 / 16, and each mean is inside of its group.
    angle = np.hypot(np.pi / 300, 0.4 / 16)
    assert 0 < placed.moved.max() < 60 * angle
    nearest = np.linalg.norm(found[:, None] - points[None], axis=-1).min(1)
    assert nearest.max() <= placed.moved.max() + 1e-4


def test_two_returns_of_a_ray_stay_and_a_third_is_lost():
    ray = np.array([0.8, 0.0, 0.6])
    points = np.array([[30.0], [10.0], [20.0], [0.0], [2000.0]]) * ray
    grid = RangeGrid(np.array([np.arctan2(0.6, 0.8)]), 3)
    placed = grid.place(points)
    # Nothing at the sensor itself, nor beyond a kilometer.
    assert placed.lost == 3
    assert placed.ranges[0].tolist() == [[-1.0, 10.0, -1.0]]
    assert placed.ranges[1].tolist() == [[-1.0, 20.0, -1.0]]
    assert placed.image(0)[0, 1].tolist() == [10.0, 0, 0, 0]
    assert placed.image(0)[0, 0].tolist() == [-1.0] * 4


@pytest.mark.parametrize("count", [0, 1])
def test_few_points(count):
    points = np.array([[5.0, 1.0, 0.5]])[:count]
    grid = RangeGrid.fitting([points], 4, 400)
    assert len(grid.place(points).moved) == count
