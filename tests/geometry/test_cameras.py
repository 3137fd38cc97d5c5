"""Projection, rays, moved cameras and transforms, against OpenCV, linear algebra and formulas written out."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sparsestreet.geometry import cameras
from sparsestreet.geometry.cameras import (
    distance_to_view,
    exact_position,
    inverse,
    moved,
    project,
    ray_directions,
    ray_matrix,
    rigidity_error,
    transform_points,
)
from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.types import Camera
from tests.scene.street import camera_at

LENS = torch.tensor([-0.28, 0.09, 2e-3, -1e-3, -0.012], dtype=torch.float64)
"""A wide-angle front camera's order of magnitude."""


def camera_of(seed: int, width: int = 13, height: int = 7) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    camera_from_world = torch.eye(4, dtype=torch.float64)
    camera_from_world[:3, :3] = to_matrix(from_rotation_vector(torch.randn(3, generator=generator).double()))
    camera_from_world[:3, 3] = torch.randn(3, generator=generator).double()
    intrinsics = torch.tensor([[11.0, 0.0, 6.1], [0.0, 12.0, 3.7], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(camera_from_world, intrinsics, width, height)


def test_exact_position_is_where_the_pose_has_its_zero():
    """For a rotation of four digits, as text files hold them, and 20 km away: -R^T t is meters off there."""
    camera = camera_of(3)
    camera.camera_from_world[:3, 3] *= 2e4
    camera.camera_from_world[:3, :3] = camera.camera_from_world[:3, :3].round(decimals=4)
    for dtype in (torch.float64, torch.float32):
        pose = camera.camera_from_world.to(dtype)
        position = exact_position(Camera(pose, camera.intrinsics, 13, 7))
        assert (pose[:3, :3].double() @ position + pose[:3, 3].double()).abs().max() < 1e-10
        assert (camera.position - position).abs().max() > 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_moved_camera_is_elsewhere_turned_as_it_was_in_its_own_dtype(dtype: torch.dtype):
    camera, vector = camera_of(3), torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    camera = replace(camera, camera_from_world=camera.camera_from_world.to(dtype))
    there = moved(camera, vector)
    assert there.camera_from_world.dtype == dtype
    assert torch.equal(there.camera_from_world[:3, :3], camera.camera_from_world[:3, :3])
    # A float32 pose knows a place at 1 m to 1e-7, three roundings.
    torch.testing.assert_close(exact_position(there), exact_position(camera) + vector, atol=1e-6, rtol=0)


def test_the_image_ends_before_its_width():
    camera = Camera(torch.eye(4), torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1]]), 4, 3)
    points = torch.tensor([[0.0, 0.0, 1.0], [4.0, 1.0, 1.0], [3.999, 2.999, 1.0], [1.0, 3.0, 1.0], [-0.001, 1.0, 1.0]])
    assert project(camera, points)[2].tolist() == [True, False, True, False, False]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.5, 100.0))
def test_rays_project_onto_their_pixel_centers(seed: int, distance: float):
    camera = camera_of(seed)
    directions = ray_directions(camera)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(7, 13, dtype=torch.float64))
    points = camera.position + distance * directions.reshape(-1, 3)
    pixels, depth, inside = project(camera, points)
    row, column = torch.meshgrid(torch.arange(7).double() + 0.5, torch.arange(13).double() + 0.5, indexing="ij")
    expected = torch.stack((column, row), dim=-1).reshape(-1, 2)
    visible = depth > 0.2
    assert torch.equal(inside, visible)
    torch.testing.assert_close(pixels[visible], expected[visible], atol=1e-9, rtol=0)


def test_the_matrix_of_rays_has_their_directions():
    camera = camera_of(4)
    row, column = torch.meshgrid(torch.arange(7).double() + 0.5, torch.arange(13).double() + 0.5, indexing="ij")
    places = torch.stack((column, row, torch.ones_like(row)), dim=-1)
    found = places @ torch.tensor(ray_matrix(camera), dtype=torch.float64).T
    torch.testing.assert_close(found / found.norm(dim=-1, keepdim=True), ray_directions(camera), atol=1e-14, rtol=0)


def test_no_points():
    pixels, depth, inside = project(camera_of(0), torch.zeros(0, 3, dtype=torch.float64))
    assert pixels.shape == (0, 2)
    assert depth.shape == inside.shape == (0,)


def test_points_may_be_on_any_device():
    camera = Camera(torch.eye(4), torch.eye(3), 8, 6)
    found = project(camera, torch.zeros(5, 3, device="meta"))  # which computes nothing, but refuses to mix devices
    assert [tensor.device.type for tensor in found] == ["meta"] * 3


def test_distance_to_view_is_a_lower_bound_and_exact_beside_a_side():
    """Against the nearest of many points that the camera sees."""
    camera = camera_at(2.0, 33, 21)
    generator = torch.Generator().manual_seed(0)
    around = (torch.rand(200_000, 3, generator=generator) - 0.5) * torch.tensor([20.0, 20.0, 20.0])
    seen = around[project(camera, around, near=1e-6)[2]].double()
    points = around[:400].double()
    distances = distance_to_view(camera, points)
    assert torch.equal(distances < 0, project(camera, points, near=1e-6)[2])
    nearest = torch.cdist(points, seen).min(1).values
    assert (distances <= nearest).all()
    # 90 degrees: the side planes stand at 45 degrees; a point 6 m ahead and 6 m + 2 m to the left is 2 sin 45 away.
    beside = torch.tensor([[8.0, 8.0, 1.5], [8.0, -8.0, 1.5], [-1.0, 0.0, 1.5]])
    torch.testing.assert_close(distance_to_view(camera, beside), torch.tensor([2**0.5, 2**0.5, 3.0]))


def test_a_margin_enlarges_the_image():
    camera = camera_at(0.0, 40, 20)
    # 10 m ahead the image is 20 m wide and 10 m high; with a quarter on each side 30 m and 15 m.
    points = torch.tensor([[10.0, 14.9, 1.5], [10.0, -15.1, 1.5], [10.0, 0.0, 8.9], [10.0, 0.0, -6.1]])
    assert (distance_to_view(camera, points, margin=0.25) < 0).tolist() == [True, False, True, False]
    assert (distance_to_view(camera, points) > 0).all()


def test_a_pinhole_is_computed_as_it_ever_was():
    """To the last bit, in the precision that training uses: a lens must cost it nothing."""
    camera = camera_of(5)
    camera = replace(camera, camera_from_world=camera.camera_from_world.float(), intrinsics=camera.intrinsics.float())
    points = 5 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    local = points @ rotation.T + translation
    pixels, depth, inside = project(camera, points)
    assert torch.equal(depth, local[:, 2])
    assert torch.equal(pixels, (local @ camera.intrinsics.T)[:, :2] / local[:, 2:].clamp(min=0.2))
    within = (pixels >= 0).all(1) & (pixels < torch.tensor([13, 7])).all(1)
    assert torch.equal(inside, within & (depth > 0.2))
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    x, y = (torch.arange(13) + 0.5 - cx) / fx, (torch.arange(7) + 0.5 - cy) / fy
    rays = torch.stack((x.expand(7, 13), y[:, None].expand(7, 13), torch.ones(7, 13)), -1) @ rotation
    assert torch.equal(ray_directions(camera), rays / rays.norm(dim=-1, keepdim=True))


def test_a_lens_bends_points_as_brown_and_conrady_say():
    camera = replace(camera_of(6), distortion=LENS)
    generator = torch.Generator().manual_seed(1)
    local = torch.rand(60, 3, generator=generator, dtype=torch.float64) - 0.5
    local[:, 2] = 0.8 + local[:, 2].abs()
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    pixels, depth, inside = project(camera, (local - translation) @ rotation)
    torch.testing.assert_close(depth, local[:, 2])
    k1, k2, p1, p2, k3 = LENS.tolist()
    for (x, y, z), pixel, seen in zip(local.tolist(), pixels.tolist(), inside.tolist(), strict=True):
        x, y = x / z, y / z
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        right = 11.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + 6.1
        down = 12.0 * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + 3.7
        assert pixel == pytest.approx([right, down], rel=1e-12)
        assert seen == (0 <= right < 13 and 0 <= down < 7)
    assert 0 < inside.sum() < 60


def test_a_point_past_the_fold_is_not_in_the_image():
    """1 - 0.9 r^2 = 0 at r = 1.054; just past it the point would lie 7.07 pixels from the center."""
    lens = torch.tensor([-0.3, 0.0, 0.0, 0.0, 0.0])
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 8.0], [0, 10.0, 6.0], [0, 0, 1]]), 16, 12, lens)
    pixels, _, inside = project(camera, torch.tensor([[1.05, 0.0, 1.0], [1.06, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert inside.tolist() == [True, False, False]
    assert pixels[1, 0] < 16


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_rays_of_a_lens_project_onto_their_pixel_centers(dtype, tolerance):
    """float32: the camera is a few meters from the origin, an eps of which is a few eps of 11 pixels at 1 m."""
    for seed in range(5):
        camera = camera_of(seed)
        pose, intrinsics = camera.camera_from_world.to(dtype), camera.intrinsics.to(dtype)
        camera = Camera(pose, intrinsics, 13, 7, LENS.to(dtype))
        directions = ray_directions(camera)
        assert directions.dtype == dtype
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(7, 13, dtype=dtype))
        depths = 1 + 50 * torch.rand(7, 13, 1, generator=torch.Generator().manual_seed(seed), dtype=dtype)
        pixels, _, inside = project(camera, (camera.position + depths * directions).reshape(-1, 3))
        row, column = torch.meshgrid(torch.arange(7) + 0.5, torch.arange(13) + 0.5, indexing="ij")
        expected = torch.stack((column, row), dim=-1).reshape(-1, 2).to(dtype)
        assert inside.all()
        torch.testing.assert_close(pixels, expected, atol=tolerance, rtol=0)
        straight = project(replace(camera, distortion=None), camera.position + 9 * directions.reshape(-1, 3))[0]
        assert (straight - expected).abs().max() > 0.3  # or the test would hold without a lens


@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.01, -0.02, 0.0), (0.0, -0.1, 0.0, 0.0, 0.0)], ids=["p1 and p2", "k2"])
def test_rays_of_a_lens_without_k1_are_those_of_opencv(lens):
    camera = replace(camera_of(0), distortion=torch.tensor(lens, dtype=torch.float64))
    rays = (ray_directions(camera) @ camera.camera_from_world[:3, :3].T).reshape(-1, 3).numpy()
    imaged, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.intrinsics.numpy(), np.array(lens))
    row, column = np.meshgrid(np.arange(7) + 0.5, np.arange(13) + 0.5, indexing="ij")
    np.testing.assert_allclose(imaged.reshape(7, 13, 2), np.stack((column, row), -1), atol=1e-9)


def test_the_rays_of_a_lens_are_found_once_for_all_its_views(monkeypatch):
    asked = []
    undistort = cameras.undistort
    monkeypatch.setattr(cameras, "undistort", lambda *a: asked.append(a) or undistort(*a))
    cameras._lens_rays.cache_clear()
    views = [replace(camera_of(seed), distortion=LENS) for seed in range(3)]
    directions = [ray_directions(view) for view in views]
    assert len(asked) == 1
    assert not torch.allclose(directions[0], directions[1])
    others = {"distortion": 2 * LENS, "intrinsics": 2 * views[0].intrinsics, "width": 9, "height": 9}
    for name, value in others.items():
        ray_directions(replace(views[0], **{name: value}))
    assert len(asked) == 5
    ray_directions(camera_of(0))
    assert len(asked) == 5


@pytest.mark.parametrize("k1", [-0.3, -0.1])
def test_a_quarter_of_the_image_makes_up_for_a_barrel(k1):
    """At the fold of a lens of k1 alone, 1 + 3 k1 r^2 = 0, a point is 1.5 times as far out as it is imaged."""
    focal = 20 / torch.tensor(torch.pi / 6).tan().item()  # 60 degrees
    intrinsics = torch.tensor([[focal, 0, 20], [0, focal, 13], [0, 0, 1]])
    camera = Camera(torch.eye(4), intrinsics, 40, 26, torch.tensor([k1, 0.0, 0.0, 0.0, 0.0]))
    slopes = 3 * torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0)) - 1.5
    points = torch.cat((slopes, torch.ones(20_000, 1)), 1)
    seen = points[project(camera, points)[2]]
    assert (distance_to_view(camera, seen, margin=0.25) < 0).all()
    assert (distance_to_view(camera, seen) > 0).any()


seeds = st.integers(0, 2**31)
examples = settings(max_examples=40, deadline=None)


def random_transform(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = to_matrix(from_rotation_vector(3 * torch.randn(3, generator=generator, dtype=torch.float64)))
    matrix[:3, 3] = 100 * torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix


@examples
@given(seeds, seeds)
def test_chains_of_transforms(first: int, second: int):
    a_from_b, b_from_c = random_transform(first), random_transform(second)
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(first), dtype=torch.float64)
    stepwise = transform_points(a_from_b, transform_points(b_from_c, points))
    torch.testing.assert_close(stepwise, transform_points(a_from_b @ b_from_c, points), atol=1e-9, rtol=0)
    torch.testing.assert_close(transform_points(inverse(a_from_b), transform_points(a_from_b, points)), points)


def test_inverse_is_that_of_linear_algebra():
    batch = torch.stack([random_transform(seed) for seed in range(40)])
    torch.testing.assert_close(inverse(batch), torch.linalg.inv(batch), atol=1e-10, rtol=0)
    assert torch.equal(inverse(batch)[1], inverse(batch[1]))
    assert inverse(batch[:0]).shape == (0, 4, 4)


def test_rigidity_error():
    assert rigidity_error(random_transform(0)) < 1e-12
    scaled = random_transform(0)
    scaled[:3, :3] *= 1.1
    assert rigidity_error(scaled) == pytest.approx(0.21)
    reflected = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    assert rigidity_error(reflected) == 1.0
    projective = random_transform(0)
    projective[3, 0] = 0.5
    assert rigidity_error(projective) == pytest.approx(0.5)
