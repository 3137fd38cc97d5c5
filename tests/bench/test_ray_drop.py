"""Rays that return nothing, on a grid made by hand: which count, and what a model of them is worth."""

import numpy as np
import pytest

from benchmarks.ray_drop import MAX_GAP, enclosed, fitted, judged


def wall(rows: int = 3, columns: int = 60, x: float = 8.0) -> np.ndarray:
    """Returns of a wall across the x axis, rays 1 degree apart."""
    azimuth = np.radians(np.linspace(25, -25, columns))[None]
    slope = np.radians(np.linspace(2, -2, rows))[:, None]
    return np.stack(np.broadcast_arrays(x + 0 * azimuth * slope, x * np.tan(azimuth), x * np.tan(slope)), -1)


def test_a_ray_counts_that_has_returns_on_both_sides_not_far_away():
    grid = wall()
    grid[1, 20:23] = np.nan
    grid[2, 5 : 6 + MAX_GAP] = np.nan  # one too many
    grid[0, :4] = np.nan  # open
    known, dropped = enclosed(grid)
    # The ends of 3 rows of 60 have one side alone, as have 4 at the open one; neither does the wide gap count nor who
    # has it on one side.
    assert len(dropped) == 3 * 58 - 4 - (MAX_GAP + 1) - 2
    assert dropped.sum() == 3
    np.testing.assert_allclose(known[dropped, 1], np.log(8 / np.cos(np.radians(25 - 50 / 59 * np.arange(20, 23)))) - 3,
                               atol=2e-3)  # fmt: skip
    turned = np.radians(25 - 50 / 59 * np.arange(20, 23))
    np.testing.assert_allclose(np.exp(known[dropped, 3]), np.cos(turned), atol=2e-3)  # of incidence: the wall is plane
    assert not known[:, 4].any()


def test_ranges_that_differ_by_a_fifth_are_an_edge_and_the_nearer_counts():
    grid = wall(columns=9)
    grid[:, 5:, :] *= 1.5
    grid[:, 4] = np.nan
    known, dropped = enclosed(grid)
    assert known[dropped, 4].all()
    np.testing.assert_allclose(np.exp(known[dropped, 1] + 3), np.linalg.norm(grid[:, 3], axis=1), rtol=1e-6)


def test_the_regression_finds_the_chances_that_were_drawn():
    dice = np.random.default_rng(0)
    known = np.stack((np.ones(40_000), dice.standard_normal(40_000)), 1)
    dropped = dice.random(40_000) < 1 / (1 + np.exp(2 - 1.5 * known[:, 1]))
    np.testing.assert_allclose(fitted(known, dropped), (-2, 1.5), atol=0.06)  # three deviations


def test_a_log_is_judged_by_the_others(tmp_path):
    """Nothing returns at 8 m in one log, and everything in the other: each is wrong about the other."""
    files = {}
    for name, far in (("a", (8.0, 30.0)), ("b", (30.0, 8.0))):
        sweep = np.concatenate([wall(32, 300, x)[::-1].transpose(1, 0, 2) for x in far])
        sweep[1:300:2] = 0.0
        files[name] = [tmp_path / f"{name}.pcd.bin"]
        np.pad(sweep.reshape(-1, 3), ((0, 0), (0, 2))).astype("<f4").tofile(files[name][0])
    for found in judged(files):
        assert found.rays == pytest.approx(2 * 32 * 300, rel=0.02)
        assert found.returned == pytest.approx(75, abs=1)
        assert found.right < 55
        assert max(found.edges, found.false_drops) < 1
