from dataclasses import replace

import pytest
import torch

from sparsestreet.geometry.transforms import inverse, transform_points
from sparsestreet.scene.initialize.gaussians import SH_CONSTANT
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.scene.nodes import Background, BackgroundSettings, RigidSettings
from sparsestreet.types import Sweep
from tests.scene.street import (
    CAR_COLOR,
    NUM_FRAMES,
    ROAD_COLOR,
    background_settings,
    rigid_settings,
    street_log,
    training_data,
)

LIDAR_ONLY = background_settings(lidar=10_000)
MOVERS = rigid_settings(classes=("Car", "Cyclist"))


def build(
    settings: BackgroundSettings,
    held_out: frozenset[int] = frozenset(),
    seed: int = 0,
    log=None,
    movers: RigidSettings = MOVERS,
) -> Background:
    return settings.build(training_data(log, held_out, movers), torch.Generator().manual_seed(seed))


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
    assert len(build(LIDAR_ONLY, movers=replace(MOVERS, min_path_length=100.0)).rows) == everything
    assert len(build(LIDAR_ONLY, movers=replace(MOVERS, classes=("Tram",))).rows) == everything
    # Cars only: the driving one is cut out; the cyclist's box takes no points of its own away.
    cars = build(LIDAR_ONLY, movers=replace(MOVERS, classes=("Car",)))
    assert len(build(LIDAR_ONLY).rows) <= len(cars.rows) < everything
    assert not (colors(cars) - torch.tensor(CAR_COLOR)).abs().max(dim=1).values.lt(1e-3).any()


def test_held_out_sweeps_are_not_used():
    held_out = frozenset({1, 3})
    means = set(map(tuple, build(LIDAR_ONLY, held_out).rows.means.tolist()))
    for sweep in street_log().sweeps:
        shared = means & set(map(tuple, sweep.points.tolist()))
        assert bool(shared) == (sweep.index not in held_out)


def test_the_number_of_points_of_each_kind():
    node = build(background_settings(lidar=40, near=30, far=20, sh_degree=1))
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
    settings = background_settings(lidar=40, near=30, far=20)
    first, second, other = build(settings), build(settings), build(settings, seed=1)
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
    settings = replace(LIDAR_ONLY, mask=StaticMaskSettings(0.5), min_gaussians=3, masked=True)
    node = build(settings)
    assert node.settings is settings
    assert node.mask.settings is settings.mask
    assert node.mask.min_gaussians == 3
    assert node.mask.sparsity_weight == 0.5
    assert node.mask.scores(node.rows).shape == (len(node.rows),)


def test_a_mask_that_is_not_trained_in_this_run_leaves_no_column():
    node = build(replace(LIDAR_ONLY, mask=StaticMaskSettings(0.5), masked=False))
    assert node.mask is None
    assert "mask_logits" not in node.rows.columns()


def test_a_log_without_lidar_starts_from_random_points():
    node = build(background_settings(lidar=40, near=10, far=5), log=replace(street_log(), sweeps=()))
    assert len(node.rows) == 15


def test_nothing_to_start_from_is_an_error():
    with pytest.raises(ValueError, match="background of 'hand-made' has nothing to start from"):
        build(LIDAR_ONLY, held_out=frozenset(range(NUM_FRAMES)))
