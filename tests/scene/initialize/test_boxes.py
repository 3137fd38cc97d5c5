from dataclasses import replace

import torch

from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.scene.initialize.gaussians import box_surface_points, lidar_in_boxes, outside_swept_boxes
from tests.scene.street import car_pose, street_log


def test_box_points_are_spread_by_area():
    size = torch.tensor([4.0, 2.0, 1.0])
    points = box_surface_points(9000, size, torch.Generator().manual_seed(0))
    on_face = (points.abs() - size / 2).abs() < 1e-6
    assert (on_face.sum(1) == 1).all()
    assert (points.abs() <= size / 2 + 1e-6).all()
    share = on_face.float().mean(0)
    # Areas 2, 4, 8 of 14; standard deviation of a share of 9,000 draws is 0.005.
    torch.testing.assert_close(share, torch.tensor([2.0, 4.0, 8.0]) / 14, atol=0.02, rtol=0)
    assert ((points[:, 2] > 0).float().mean() - 0.5).abs() < 0.03


def test_swept_boxes_are_those_of_every_frame_but_the_held_out_ones():
    driving = street_log().tracks[1]
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([20.0, 6.0, 3.0])
    points = points + torch.tensor([2.0, -2.0, -0.5])
    for held_out in (frozenset(), frozenset({0, 1})):
        inside = torch.zeros(len(points), dtype=torch.bool)
        for frame in set(range(5)) - held_out:
            in_box = transform_points(inverse(car_pose(frame)), points.double())
            inside |= (2 * in_box.abs() <= driving.size).all(1)
        assert inside.sum() > 100
        assert torch.equal(outside_swept_boxes([driving], points, held_out), ~inside)
    assert outside_swept_boxes([], points).all()


def test_an_object_starts_from_colored_returns_alone():
    """Of its three returns a camera sees the first two."""
    log = street_log()
    car, sweep = log.tracks[0], next(sweep for sweep in log.sweeps if sweep.index == int(log.tracks[0].frames[0]))
    inside = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.2, 0.1], [0.0, 0.0, 0.3]])
    world = transform_points(car.world_from_object[0], inside.double()).float()
    seen = replace(sweep, points=world, colors=torch.rand(3, 3), colored=torch.tensor([True, True, False]))
    (found,) = lidar_in_boxes([car], [seen])
    torch.testing.assert_close(found.positions, inside[:2], atol=1e-5, rtol=0)
    assert torch.equal(found.colors, seen.colors[:2])
