"""Edges of the lidar against those of images, with a shift that is known."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.lidar import EdgeShift, edge_shift
from sparsestreet.types import Camera, Frame, Sweep

FOCAL, WIDTH, HEIGHT = 100.0, 120, 80


def camera() -> Camera:
    intrinsics = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), intrinsics, WIDTH, HEIGHT)


def box_image(right: float, down: float) -> torch.Tensor:
    """A white box, 40 to 80 and 25 to 55 pixels, moved; each pixel has the part of it that the box covers."""
    x = (torch.arange(WIDTH) + 0.5 - 60 - right).abs()
    y = (torch.arange(HEIGHT) + 0.5 - 40 - down).abs()
    covered = (20.5 - x).clamp(0, 1)[None] * (15.5 - y).clamp(0, 1)[:, None]
    return (255 * covered).round().to(torch.uint8)[..., None].expand(-1, -1, 3)


def returns(index: int) -> Sweep:
    """Random rays; those that meet the box end at 5 m, the others at 20 m."""
    pixels = torch.rand(6000, 2, generator=torch.Generator().manual_seed(index)) * torch.tensor([WIDTH, HEIGHT])
    in_box = ((pixels - torch.tensor([60.0, 40.0])).abs() < torch.tensor([20.0, 15.0])).all(1)
    depth = torch.where(in_box, 5.0, 20.0)
    rays = torch.cat(((pixels - torch.tensor([WIDTH / 2, HEIGHT / 2])) / FOCAL, torch.ones(6000, 1)), 1)
    points = rays * depth[:, None]
    return Sweep(index, 0.0, points, torch.full_like(points, 0.5), torch.ones(6000, dtype=torch.bool))


def measured(right: float, down: float, instants: int = 8, ego: torch.Tensor | None = None) -> EdgeShift | None:
    frame = Frame(camera(), 0.0, 0, 0, image=box_image(right, down), ego=ego)
    frames = as_frames([replace(frame, frame_index=index) for index in range(instants)])
    return edge_shift(frames, Sweeps.of(tuple(returns(index) for index in range(instants))))


@pytest.mark.parametrize(("right", "down"), [(0.0, 0.0), (1.0, -2.0), (-2.4, 0.7), (0.3, 2.9)])
def test_a_shift_of_the_image_is_measured(right: float, down: float):
    found = measured(right, down)
    assert found is not None
    # A step is half a pixel, a pixel's slope a tent of two pixels; returns lie within a pixel of the edge.
    assert (found.right, found.down) == pytest.approx((right, down), abs=0.2)


def test_a_shift_beyond_the_reach_is_said_to_be_at_its_end():
    found = measured(4.6, 0.0)
    assert found is not None
    assert found.right == pytest.approx(4.0, abs=0.3)


def test_few_edges_say_nothing():
    assert measured(0.0, 0.0, instants=1) is None


def test_images_without_a_sweep_are_passed_over():
    frame = Frame(camera(), 0.0, 0, 0, image=box_image(0.0, 0.0))
    frames = as_frames([replace(frame, frame_index=index) for index in range(16)])
    sweeps = Sweeps.of(tuple(returns(index) for index in range(8)))
    assert edge_shift(frames, sweeps) is not None
    assert edge_shift(frames, Sweeps.of(())) is None


def test_the_recording_car_has_no_edges_of_the_street():
    assert measured(0.0, 0.0, ego=torch.ones(HEIGHT, WIDTH, dtype=torch.bool)) is None
