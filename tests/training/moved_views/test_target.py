"""What returns say of pixels: by hand, and against slow definitions."""

import pytest
import torch
from torch import Tensor

from sparsestreet.training.moved_views.returns import Colors, Returns, behind_boxes, target, unhidden
from sparsestreet.types import Camera

WIDTH, HEIGHT = 8, 6
NONE = Returns.concatenate([])


def camera() -> Camera:
    """At the origin along z; a point at depth z is 4 / z pixels from the middle for each meter."""
    return Camera(torch.eye(4), torch.tensor([[4.0, 0, 4.0], [0, 4.0, 3.0], [0, 0, 1]]), WIDTH, HEIGHT)


def at_pixel(column: float, line: float, depth: float) -> list[float]:
    return [(column - 4) * depth / 4, (line - 3) * depth / 4, depth]


def returns(*points: list[float], weight: float = 1.0) -> Returns:
    """Each in a color of its own."""
    count = len(points)
    colors = torch.arange(3.0 * count).view(count, 3) / (3 * count)
    return Returns(torch.tensor(points), Colors(colors, colors > 0.5), torch.full((count,), weight))


def test_a_pixel_takes_its_nearest_return():
    street = returns(at_pixel(2.5, 1.5, 5.0), at_pixel(2.6, 1.4, 4.9), at_pixel(6.5, 4.5, 7.0), weight=0.5)
    found = target(camera(), street, NONE, [])
    assert torch.nonzero(found.weight).tolist() == [[1, 2], [4, 6]]
    assert found.depth[1, 2] == pytest.approx(4.9)
    assert found.depth[4, 6] == pytest.approx(7.0)
    for pixel, row in (((1, 2), 1), ((4, 6), 2)):
        assert torch.equal(found.colors.values[pixel], street.colors.values[row])
        assert torch.equal(found.colors.cut_off[pixel], street.colors.cut_off[row])
    assert set(found.weight.unique().tolist()) == {0.0, 0.5}


def test_a_return_behind_a_clearly_nearer_neighbor_is_not_seen():
    """2 pixels away it is hidden, 3 pixels away not: the window is 5 wide."""
    near = at_pixel(1.5, 2.5, 4.0)
    for column, seen in ((3.5, False), (4.5, True)):
        street = returns(near, at_pixel(column, 2.5, 9.0))
        assert bool(target(camera(), street, NONE, []).weight[2, int(column)] > 0) is seen
    # 1.15 x 4 m + 0.3 m = 4.9 m is how far a surface may lean away.
    for depth, seen in ((4.89, True), (4.91, False)):
        found = target(camera(), returns(near, at_pixel(2.5, 2.5, depth)), NONE, [])
        assert bool(found.weight[2, 2] > 0) is seen


def test_returns_at_the_rim_of_a_pixel_do_not_count():
    street = returns(at_pixel(2.5, 1.7, 5.0), at_pixel(5.5, 3.8, 5.0))
    assert torch.nonzero(target(camera(), street, NONE, [], reach=0.25).weight).tolist() == [[1, 2]]


def test_too_near_and_too_far():
    street = returns(at_pixel(1.5, 1.5, 0.45), at_pixel(6.5, 4.5, 81.0))
    assert not target(camera(), street, NONE, []).weight.any()


def box(x: float, y: float, z: float) -> Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return pose


def test_behind_a_moving_object_nothing_is_known_but_the_object_itself():
    boxes = [(box(0.0, 0.0, 6.0), torch.tensor([2.0, 2.0, 2.0]))]
    street = returns(at_pixel(4.5, 3.5, 7.5), at_pixel(1.5, 1.5, 7.5), at_pixel(4.4, 2.5, 4.5))
    found = target(camera(), street, NONE, boxes)
    assert torch.nonzero(found.weight).tolist() == [[1, 1], [2, 4]]
    assert found.depth[2, 4] == pytest.approx(4.5)  # before the box
    car = returns(at_pixel(4.5, 3.5, 5.2))
    found = target(camera(), street.at(torch.tensor([0])), car, boxes)
    assert found.depth[3, 4] == pytest.approx(5.2)


def test_boxes_against_points_along_the_way():
    """A point is hidden if one of many points between it and the camera lies in a box."""
    generator = torch.Generator().manual_seed(4)
    points = torch.randn(200, 3, generator=generator) * torch.tensor([3.0, 1.5, 3.0]) + torch.tensor([1.0, 0.5, 7.0])
    turned = box(1.0, 0.5, 5.0)
    angle = torch.tensor(0.6, dtype=torch.float64)
    turned[0, 0], turned[0, 2], turned[2, 0], turned[2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    size = torch.tensor([4.0, 2.0, 1.5])
    steps = torch.linspace(0, 1, 4001, dtype=torch.float64)[:, None, None]
    local = (steps * points.double() - turned[:3, 3]) @ turned[:3, :3]
    inside = (local.abs() <= 0.55 * size.double()).all(-1).any(0)
    behind_the_camera = box(-1.0, -0.5, -6.0)  # on the lines to many points, but on their other side
    found = behind_boxes(camera(), points, [(turned, size), (behind_the_camera, torch.tensor([4.0, 3.0, 2.0]))])
    assert 10 < int(inside.sum()) < 190
    # A ray that touches an edge may fall between two of the steps.
    assert int((found != inside).sum()) <= 1


def test_unhidden_against_a_slow_definition():
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(300, 3, generator=generator) * torch.tensor([8.0, 6.0, 3.0]) - torch.tensor([4.0, 3.0, -3.0])
    rows, positions, depths = unhidden(camera(), points, window=3)
    z = points[:, 2]
    pixels = 4 * points[:, :2] / z[:, None] + torch.tensor([4.0, 3.0])
    inside = (z > 0.2) & (pixels >= 0).all(1) & (pixels[:, 0] < WIDTH) & (pixels[:, 1] < HEIGHT)
    cells = pixels.floor()
    expected = []
    for row in torch.nonzero(inside).flatten().tolist():
        beside = inside & ((cells - cells[row]).abs() <= 1).all(1)
        if z[row] <= 1.15 * z[beside].min() + 0.3:
            expected.append(row)
    assert rows.tolist() == expected
    assert 20 < len(expected) < int(inside.sum())
    torch.testing.assert_close(positions, pixels[rows])
    assert torch.equal(depths, z[rows])


@pytest.mark.parametrize("street", [NONE, returns(at_pixel(20.0, 1.0, 5.0))])
def test_without_a_return_nothing_is_known(street):
    found = target(camera(), street, NONE, [])
    assert found.weight.shape == (HEIGHT, WIDTH)
    assert not found.weight.any()
    assert torch.isfinite(found.depth).all()
    assert (found.depth > 0).all()
