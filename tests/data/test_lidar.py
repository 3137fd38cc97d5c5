"""Coloring and the z-buffer on hand-made cases."""

import torch

from sparsestreet.data.lidar import color_points, depth_image, near_returns
from sparsestreet.types import Camera, Frame

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
