from dataclasses import replace

import pytest
import torch
from sparsestreet.scene.seeds import BackgroundSettings
from sparsestreet.scene.seeds.rows import SH_CONSTANT

from sparsestreet.geometry.transforms import inverse, transform_points
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes import Background
from sparsestreet.types import Sweep
from tests.scene.street import CAR_COLOR, NUM_FRAMES, ROAD_COLOR, street_log

LIDAR_ONLY = BackgroundSettings(lidar_points=10_000, near_points=0, far_points=0)


def build(seeds: BackgroundSettings, held_out: frozenset[int] = frozenset(), seed: int = 0, log=None) -> Background:
    log = log or street_log()
    frames = [frame for frame in log.frames if frame.frame_index not in held_out]
    return seeds.build(log, frames, held_out, torch.Generator().manual_seed(seed))


def colors(node: Background) -> torch.Tensor:
    return 0.5 + SH_CONSTANT * node.rows.sh_dc[:, 0]


def test_lidar_outside_moving_boxes_keeps_its_color():
    node = build(LIDAR_ONLY)
    torch.testing.assert_close(colors(node), torch.tensor(ROAD_COLOR).expand(len(node.rows), 3))
    driving = street_log().tracks[1]
    for sweep in street_log().sweeps:
        world_points = sweep.points
        in_box = transform_points(inverse(driving.world_from_object[sweep.index]), world_points.double())
        inside = (in_box.abs() < driving.size / 2).all(1)
        assert inside.any()
        assert not set(map(tuple, world_points[inside].tolist())) & set(map(tuple, node.rows.means.tolist()))


def test_what_does_not_move_or_is_of_another_class_stays():
    everything = sum(int(sweep.colored.sum()) for sweep in street_log().sweeps)
    assert len(build(replace(LIDAR_ONLY, min_path_length=100.0)).rows) == everything
    assert len(build(replace(LIDAR_ONLY, moving_classes=("Tram",))).rows) == everything
    # Cars only: the driving one is cut out; the cyclist's box takes no points of its own away.
    cars = build(replace(LIDAR_ONLY, moving_classes=("Car",)))
    assert len(build(LIDAR_ONLY).rows) <= len(cars.rows) < everything
    assert not (colors(cars) - torch.tensor(CAR_COLOR)).abs().max(dim=1).values.lt(1e-3).any()


def test_held_out_sweeps_are_not_used():
    held_out = frozenset({1, 3})
    means = set(map(tuple, build(LIDAR_ONLY, held_out).rows.means.tolist()))
    for sweep in street_log().sweeps:
        shared = means & set(map(tuple, sweep.points.tolist()))
        assert bool(shared) == (sweep.index not in held_out)


def test_the_number_of_points_of_each_kind():
    seeds = BackgroundSettings(lidar_points=40, near_points=30, far_points=20, sh_degree=1)
    node = build(seeds)
    log = street_log()
    assert len(node.rows) == 90
    assert node.rows.sh_rest.shape == (90, 3, 3)
    distance = (node.rows.means - log.center).norm(dim=1)
    assert (distance[40:70] <= log.radius * 1.0001).all()
    assert (distance[70:] >= log.radius * 0.9999).all()
    cameras = torch.stack([frame.camera.position for frame in log.frames])
    from_camera = (node.rows.means[40:, None] - cameras).norm(dim=2).min(1).values
    assert (node.rows.log_scales.exp()[40:, 0] <= 0.02 * from_camera * 1.0001).all()


def test_the_same_seed_gives_the_same_rows():
    seeds = BackgroundSettings(lidar_points=40, near_points=30, far_points=20)
    first, second, other = build(seeds), build(seeds), build(seeds, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert not torch.equal(first.rows.means, other.rows.means)


def test_duplicated_returns_start_finite():
    log = street_log()
    sweep = log.sweeps[0]
    doubled = Sweep(0, sweep.points.repeat(5, 1), sweep.colors.repeat(5, 1), sweep.colored.repeat(5))
    node = build(LIDAR_ONLY, log=replace(log, sweeps=(doubled,)))
    assert torch.isfinite(node.rows.log_scales).all()
    assert all(torch.isfinite(parameter).all() for parameter in node.parameters())


def test_a_mask_arrives_at_the_node():
    mask = StaticMask(weight=0.5, min_gaussians=3)
    node = build(replace(LIDAR_ONLY, mask=mask))
    assert node.mask is mask
    assert node.mask_scores().shape == (len(node.rows),)


def test_a_log_without_lidar_starts_from_random_points():
    node = build(BackgroundSettings(near_points=10, far_points=5), log=replace(street_log(), sweeps=()))
    assert len(node.rows) == 15


def test_nothing_to_start_from_is_an_error():
    with pytest.raises(ValueError, match="background of 'hand-made' has no seeds"):
        build(LIDAR_ONLY, held_out=frozenset(range(NUM_FRAMES)))
