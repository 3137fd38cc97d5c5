"""Coloring and the z-buffer on hand-made cases."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.lidar import EdgeShift, color_points, depth_image, edge_shift, near_returns
from sparsestreet.types import Camera, Frame, Sweep

# At the origin, looking along z; a point (x, y, z) falls on pixel (2 x/z + 1.5, 2 y/z + 1).
CAMERA = Camera(torch.eye(4), torch.tensor([[2.0, 0, 1.5], [0, 2.0, 1.0], [0, 0, 1]]), width=3, height=2)
TURNED = Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])), CAMERA.intrinsics, width=3, height=2)
IMAGE = torch.arange(18, dtype=torch.uint8).reshape(2, 3, 3)


def frame(camera: Camera = CAMERA, image: torch.Tensor = IMAGE, ego: torch.Tensor | None = None) -> Frame:
    return Frame(camera, 0.0, 0, 0, image=image, ego=ego)


def test_each_point_gets_the_pixel_it_falls_into():
    points = torch.tensor([[0.0, 0.2, 1.0], [-0.7, -0.4, 1.0], [1.4, 0.8, 2.0], [0.0, 0.0, -1.0], [5.0, 0.0, 1.0]])
    colors, colored = color_points(points, [frame()])
    assert colored.tolist() == [True, True, True, False, False]
    expected = torch.stack((IMAGE[1, 1], IMAGE[0, 0], IMAGE[1, 2])).float() / 255
    assert torch.equal(colors[:3], expected)
    assert torch.equal(colors[3:], torch.full((2, 3), 0.5))


def test_the_first_camera_counts_and_others_fill_in():
    points = torch.tensor([[0.0, 0.2, 1.0], [0.0, 0.2, -1.0]])
    views = [frame(), frame(image=IMAGE + 100), frame(TURNED, IMAGE + 50)]
    colors, colored = color_points(points, views)
    assert colored.all()
    assert torch.equal(colors, torch.stack((IMAGE[1, 1], IMAGE[1, 1] + 50)).float() / 255)


def test_an_image_that_is_white_there_counts_where_no_other_shows_the_point():
    """Of one channel, too; of several white ones the first."""
    point = torch.tensor([[0.0, 0.2, 1.0]])
    white, other, gray = IMAGE.clone(), IMAGE.clone(), IMAGE + 100
    white[1, 1, 2], other[1, 1, 0] = 250, 255
    for images, wanted in (((white, other), white), ((white, gray, IMAGE), gray), ((gray, white), gray)):
        colors, _ = color_points(point, [frame(image=image) for image in images])
        assert torch.equal(colors[0], wanted[1, 1].float() / 255)


def test_the_nearest_point_wins_in_any_order():
    points = torch.tensor([[0.0, 0.2, 4.0], [0.0, 0.2, 1.0], [0.0, 0.2, 2.0], [-0.7, -0.4, 1.0]])
    expected = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        assert torch.equal(depth_image(points[order], CAMERA), expected)


def test_what_the_recording_car_hides_has_neither_color_nor_depth():
    points = torch.tensor([[0.0, 0.2, 1.0], [-0.7, -0.4, 1.0]])
    hood = torch.zeros(2, 3, dtype=torch.bool)
    hood[1] = True
    colors, colored = color_points(points, [frame(ego=hood)])
    assert colored.tolist() == [False, True]
    assert torch.equal(colors, torch.stack((torch.full((3,), 0.5), IMAGE[0, 0] / 255)))
    # Another camera may see it.
    colors, colored = color_points(points, [frame(ego=hood), frame(image=IMAGE + 100)])
    assert torch.equal(colors, torch.stack((IMAGE[1, 1] + 100, IMAGE[0, 0])) / 255)
    assert depth_image(points, CAMERA, hood).tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]


def test_no_points_give_no_color_and_no_depth():
    empty = torch.zeros(0, 3)
    colors, colored = color_points(empty, [frame()])
    assert colors.shape == (0, 3)
    assert colored.shape == (0,)
    assert not depth_image(empty, CAMERA).any()


def test_without_cameras_nothing_is_colored():
    _, colored = color_points(torch.ones(3, 3), [])
    assert not colored.any()


def test_near_returns_is_a_square_about_each_return():
    depth = torch.zeros(9, 20)
    depth[2, 3], depth[8, 19] = 5.0, 7.0
    rows, columns = torch.meshgrid(torch.arange(9), torch.arange(20), indexing="ij")
    # A tenth of the longer side, 20, is 2 pixels.
    expected = ((rows - 2).abs() <= 2) & ((columns - 3).abs() <= 2)
    expected |= ((rows - 8).abs() <= 2) & ((columns - 19).abs() <= 2)
    assert torch.equal(near_returns(depth, reach=0.1), expected)
    assert not near_returns(torch.zeros(4, 5)).any()


def test_a_lens_decides_which_pixel_a_point_falls_into():
    """r^2 = 0.2: (0.4, 0.2) is imaged at 0.94 of it, 15.04 and 7.52 pixels from the center in place of 16 and 8."""
    intrinsics = torch.tensor([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
    camera = Camera(torch.eye(4), intrinsics, 40, 24, torch.tensor([-0.3, 0.0, 0.0, 0.0, 0.0]))
    image = torch.zeros(24, 40, 3, dtype=torch.uint8)
    image[19, 35], image[20, 36] = torch.tensor([255, 0, 51]), 102
    point = torch.tensor([[2.0, 1.0, 5.0]])
    assert torch.equal(color_points(point, [frame(camera, image)])[0], torch.tensor([[1.0, 0.0, 0.2]]))
    assert depth_image(point, camera).nonzero().tolist() == [[19, 35]]


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
