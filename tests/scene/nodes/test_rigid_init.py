from dataclasses import replace
from typing import cast

import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.ops.spherical_harmonics import FIRST
from sparsestreet.scene.nodes import Rigid, RigidSettings
from sparsestreet.triangulation import StreetPoints
from tests.scene.street import (
    CAR_COLOR,
    NUM_FRAMES,
    car_pose,
    degree,
    pose,
    rigid_settings,
    street_log,
    track,
    training_data,
    triangulated,
)
from tests.typed import as_a, there

CARS = rigid_settings(box_points=50)


def build(settings: RigidSettings, held_out: frozenset[int] = frozenset(), log=None) -> Rigid | None:
    return cast(
        Rigid | None, settings.build(training_data(log, held_out, movers=settings), torch.Generator().manual_seed(0))
    )


def instance_counts(node: Rigid | None) -> list[int]:
    return there(node).instances().counts().tolist()


def test_only_what_moves_and_is_of_the_classes():
    node = build(CARS)
    assert node.sizes.tolist() == [[4.0, 2.0, 1.5]]
    assert instance_counts(node) == [60 * NUM_FRAMES]
    assert build(replace(CARS, classes=("Car", "Cyclist"))).sizes.shape == (2, 3)
    assert build(replace(CARS, classes=("Tram",))) is None
    assert build(replace(CARS, min_path_length=50.0)) is None


def test_points_lie_in_the_box_in_the_cars_color():
    node = build(CARS)
    assert (node.rows.means.abs() <= node.sizes[0] / 2 + 1e-4).all()
    colors = 0.5 + FIRST * node.rows.sh_dc[:, 0]
    torch.testing.assert_close(colors, torch.tensor(CAR_COLOR).expand_as(colors))


def test_the_node_puts_the_points_back_where_lidar_saw_them():
    """The box poses, the pooling and the node's motion undo each other: sweep 2 must be found again at its time."""
    node, log = build(CARS), street_log()
    world = node.gaussians_at(log.frames[2], degree(0)).means
    seen = log.sweeps[2].points[50:110]
    nearest = (seen[:, None] - world[None]).norm(dim=2).min(1).values
    assert nearest.max() < 1e-4  # float32 keyframes and points at 20 m


def test_few_points_are_filled_up_on_the_box():
    node = build(replace(CARS, box_points=50), log=street_log(car_points=2))
    assert instance_counts(node) == [50]
    added = node.rows.means[2 * NUM_FRAMES :]
    on_a_face = ((added.abs() - node.sizes[0] / 2).abs() < 1e-5).any(1)
    assert on_a_face.all()
    colors = 0.5 + FIRST * node.rows.sh_dc[:, 0]
    torch.testing.assert_close(colors, torch.tensor(CAR_COLOR).expand_as(colors))  # the mean of equal colors


def test_an_instance_that_lidar_never_hit_is_a_gray_box():
    node = build(CARS, log=replace(street_log(), sweeps=Sweeps.of(())))
    assert instance_counts(node) == [50]
    assert (node.rows.sh_dc.abs() < 1e-6).all()


def test_without_points_on_the_box_only_what_was_measured_starts():
    node = build(replace(CARS, box_points=0), log=street_log(car_points=2))
    assert instance_counts(node) == [2 * NUM_FRAMES]
    one = build(replace(CARS, box_points=0, points_per_instance=1), log=street_log(car_points=2))
    assert instance_counts(one) == [1]
    assert one.gaussians_at(street_log().frames[2], degree(0)).means.isfinite().all()


def test_without_points_on_the_box_an_instance_that_lidar_never_hit_is_left_out():
    log, settings = street_log(), replace(CARS, box_points=0)
    far_away = [pose(0.0, (500.0 + 3 * frame, 0.0, 1.0)) for frame in range(NUM_FRAMES)]
    two = replace(log, tracks=(track("far away", list(range(NUM_FRAMES)), far_away), *log.tracks))
    node = build(settings, log=two)
    assert node.names == ("driving",)
    assert torch.equal(node.rows.means, build(settings).rows.means)
    assert torch.equal(node.keyframe_translations, build(settings).keyframe_translations)
    assert build(settings, log=replace(log, sweeps=Sweeps.of(()))) is None


def test_points_from_images_in_the_box_join_those_of_the_lidar():
    """In the box's frame, in their color; an instance without any lidar starts from them, and is filled up."""
    inside = [[1.0, 0.5, 0.25], [-1.0, -0.5, 0.0]]
    points = StreetPoints(triangulated([]), {"driving": triangulated(inside, color=(0.2, 0.4, 0.6))})
    for log, total in ((street_log(), 60 * NUM_FRAMES + 2), (replace(street_log(), sweeps=Sweeps.of(())), 50)):
        node = CARS.build(training_data(log, movers=CARS, points=points), torch.Generator().manual_seed(0))
        assert instance_counts(as_a(Rigid, node)) == [total]
        assert node.rows.means[:2].tolist() == inside
        colors = 0.5 + FIRST * node.rows.sh_dc[:, 0]
        torch.testing.assert_close(colors[:2], torch.tensor([[0.2, 0.4, 0.6]] * 2))
    torch.testing.assert_close(colors, torch.tensor([0.2, 0.4, 0.6]).expand(50, 3))  # the box too


def test_scales_are_those_of_each_instance_alone():
    """Two cars with the same points: pooled in one frame every point would have a neighbor at distance 0."""
    log = street_log()
    twin = track("twin", list(range(NUM_FRAMES)), [car_pose(frame) for frame in range(NUM_FRAMES)])
    alone, both = build(CARS), build(CARS, log=replace(log, tracks=(*log.tracks, twin)))
    assert instance_counts(both) == [300, 300]
    for instance in (0, 1):
        torch.testing.assert_close(both.rows.log_scales[both.rows.instances == instance], alone.rows.log_scales)


def test_held_out_frames_give_neither_points_nor_poses():
    node = build(CARS, held_out=frozenset({2}))
    assert instance_counts(node) == [60 * (NUM_FRAMES - 1)]
    assert node.keyframe_valid.sum().item() == NUM_FRAMES - 1
    assert node.pose_at(0.5).present.tolist() == [True]


def test_a_track_only_in_held_out_frames_is_left_out():
    assert build(replace(CARS, classes=("Cyclist",)), held_out=frozenset({1, 2})) is None
