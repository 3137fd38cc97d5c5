"""Surfaces that are known, seen from several sides of a turned world far from its zero."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from sparsestreet.demand import DemandError
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.meshes import Mesh
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene import surroundings as module
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.surroundings import DepthImage, fused, surroundings, without_ground
from sparsestreet.types import Camera, View
from tests.scene.street import background, random_rows, rigid
from tests.typed import there

TURN, SHIFT = Rotation.from_euler("zyx", [2.0, 0.3, -0.4]).as_matrix(), np.array([131.0, -208.0, 15.5])
VOXEL = 0.2
RADIUS = 1.7
LOW, HIGH = np.array([3.0, -1.0, 0.0]), np.array([5.0, 1.5, 2.0])

Depth = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Origin [3] and rays [3, n], in the frame of the shapes -> how many rays it is to the surface."""


def sphere(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    a, b, c = (rays**2).sum(0), origin @ rays, origin @ origin - RADIUS**2
    with np.errstate(invalid="ignore"):
        met = (-b - np.sqrt(b * b - a * c)) / a
    return np.where(met > 0, met, np.inf)


def floor(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """z = 0 within 6 m, with a round hole."""
    met = -origin[2] / rays[2]
    x, y = origin[:2, None] + met * rays[:2]
    return np.where((met > 0) & (np.hypot(x, y) < 6) & (np.hypot(x + 3, y) > 1), met, np.inf)


def box(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    ends = (np.stack([LOW, HIGH])[:, :, None] - origin[:, None]) / rays
    near, far = ends.min(0).max(0), ends.max(0).min(0)
    return np.where((near < far) & (near > 0), near, np.inf)


def camera(place: np.ndarray, at: np.ndarray, size: tuple[int, int] = (90, 70)) -> Camera:
    """A camera in the world that looks from one point of the shapes' frame at another."""
    ahead = (at - place) / np.linalg.norm(at - place)
    right = np.cross(ahead, [0.1, 0.2, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = TURN @ np.stack([right, np.cross(ahead, right), ahead], 1)
    pose[:3, 3] = TURN @ place + SHIFT
    (width, height), focal = size, 0.9 * size[0]
    intrinsics = torch.tensor([[focal, 0.0, 0.47 * width], [0.0, 1.05 * focal, 0.52 * height], [0.0, 0.0, 1.0]])
    return Camera(inverse(torch.from_numpy(pose)).float(), intrinsics, width, height)


def depth_image(place: Sequence[float], at: Sequence[float], *shapes: Depth) -> DepthImage:
    made = camera(np.array(place), np.array(at))
    row, column = np.mgrid[: made.height, : made.width] + 0.5
    rays = np.linalg.inv(made.intrinsics.double().numpy()) @ np.stack([column, row, np.ones_like(row)]).reshape(3, -1)
    rays = TURN.T @ made.camera_from_world[:3, :3].double().numpy().T @ rays
    met = np.min([shape(np.array(place), rays) for shape in shapes], axis=0)
    return DepthImage(met.reshape(row.shape).astype(np.float32), made)


def around() -> Iterator[list[float]]:
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            for z in (-1, 0, 1):
                if (x, y, z) != (0, 0, 0):
                    yield (7 * np.array([x, y, z]) / np.linalg.norm([x, y, z])).tolist()


def own(mesh: Mesh) -> np.ndarray:
    """The vertices in the frame of the shapes."""
    return (mesh.vertices - SHIFT) @ TURN


@pytest.mark.lengthy
def test_a_sphere_seen_from_all_sides_is_one_closed_surface():
    """It spans several blocks: between them no crack is left, and no triangle is turned."""
    found = there(fused([depth_image(place, [0, 0, 0], sphere) for place in around()], VOXEL))
    away = np.linalg.norm(own(found), axis=1) - RADIUS
    assert np.abs(away).max() < 0.4 * VOXEL
    read = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert len({tuple(block) for block in np.floor(found.vertices / (16 * VOXEL)).astype(int)}) > 3
    assert read.is_watertight
    assert read.euler_number == 2
    assert read.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)


@pytest.mark.lengthy
def test_a_floor_with_a_hole_and_a_box_on_it():
    """What nobody sees, the floor below the box and in the hole, is not there."""
    places = [[9, 8, 5], [-8, 7, 6], [-7, -9, 5], [8, -8, 6], [11, 1, 4], [1, -10, 5], [0, 11, 6], [-6, 1, 9]]
    found = there(fused([depth_image(place, [1, 0, 0], floor, box) for place in places], VOXEL))
    x, y, z = own(found).T
    to_box = np.linalg.norm(np.maximum(np.maximum(LOW - own(found), own(found) - HIGH), 0), axis=1)
    inside = np.minimum(own(found) - LOW, HIGH - own(found)).min(1)
    off = np.minimum(np.abs(z), np.where(to_box > 0, to_box, np.abs(inside)))
    apart = np.minimum(np.abs(np.hypot(x + 3, y) - 1), np.abs(np.hypot(x, y) - 6)) > 3 * VOXEL
    assert np.quantile(off[apart], 0.98) < 0.4 * VOXEL
    assert off.max() < 2.5 * VOXEL  # behind an edge, some voxels are behind it for all who see it
    below = (np.abs(z) < 0.1) & (np.maximum(LOW - own(found), own(found) - HIGH)[:, :2].max(1) < -0.4)
    assert not below.any()
    assert np.hypot(x + 3, y).min() > 1 - VOXEL
    for points, count in (
        (np.array([[-1.0, 3.0, 0.0], [1.0, -4.0, 0.0], [4.0, 0.2, 2.0], [5.0, 0.5, 1.0]]), 4),
        (
            np.array([[3.0, 0.5, 1.0], [4.0, 1.5, 1.2], [-4.6, 0.0, 0.0]]),
            3,
        ),
    ):
        nearest = np.linalg.norm(own(found)[None] - points[:, None], axis=2).min(1)
        assert (nearest < VOXEL).sum() == count
    a, b, c = own(found)[found.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    flat = (np.abs(own(found)[found.faces][:, :, 2]) < 0.05).all(1)
    assert (normals[flat, 2] > 0).mean() > 0.99  # slivers may stand on edge


def wall(distance: float) -> Depth:
    return lambda origin, rays: (distance - origin[0]) / rays[0]


@pytest.mark.lengthy
def test_what_two_views_see_is_not_there_and_one_in_five_is_outvoted():
    places = [[0, y, 0] for y in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    seen = [depth_image(place, [5, 0, 0], wall(6.0)) for place in places]
    assert fused(seen[:2], VOXEL) is None
    assert fused([], VOXEL) is None
    nothing = [replace(one, depths=np.full_like(one.depths, np.inf)) for one in seen]
    assert fused(nothing, VOXEL) is None
    assert fused([replace(one, depths=np.full_like(one.depths, np.nan)) for one in seen], VOXEL) is None
    np.testing.assert_allclose(own(there(fused(seen[:3], VOXEL)))[:, 0], 6.0, atol=0.01)
    wrong = [*seen[:4], depth_image([0.0, 0.4, 0.0], [5, 0, 0], wall(4.5))]
    mesh = there(fused(wrong, VOXEL))
    np.testing.assert_allclose(own(mesh)[:, 0], 6.0, atol=0.16)
    # Not known is not free: half of each image is left out, and so is half of the wall.
    half = [replace(one, depths=np.where(np.arange(90) < 45, one.depths, np.float32(np.nan))) for one in seen]
    wide = there(fused(seen, VOXEL)), there(fused(half, VOXEL))
    assert np.ptp(own(wide[1])[:, 1]) == pytest.approx(0.5 * np.ptp(own(wide[0])[:, 1]), abs=0.6)


def scene_of_a_wall() -> tuple[SceneGraph, list[View]]:
    """A wall of Gaussians 6 m ahead; a parked car of 1 m is 3 m ahead, a second one far to the side."""
    y, z = (side.ravel() for side in np.meshgrid(np.arange(-5, 5, 0.1), np.arange(-3, 3, 0.1)))
    rows, car = random_rows(len(y), 1), random_rows(200, 2, instances=torch.zeros(200, dtype=torch.int64))
    quaternion = np.roll(Rotation.from_matrix(TURN).as_quat(), 1)
    with torch.no_grad():
        rows.means[:] = torch.from_numpy(np.stack([np.full(len(y), 6.0), y, z], 1) @ TURN.T + SHIFT).float()
        rows.log_scales[:] = torch.tensor([0.005, 0.08, 0.08]).log()
        rows.quaternions[:] = torch.from_numpy(quaternion).float()
        rows.opacity_logits.fill_(4.0)
        car.means[:] = torch.from_numpy(np.random.default_rng(1).uniform(-0.5, 0.5, (200, 3))).float()
        car.log_scales.fill_(np.log(0.2))
        car.opacity_logits.fill_(4.0)
    place = torch.from_numpy(TURN @ [3.0, 0.0, 0.0] + SHIFT).float().repeat(1, 2, 1)
    still = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(1, 2, 1)
    times = torch.tensor([[0.0, 1.0]])
    parked = rigid(
        car, Trajectories(times, still, place, torch.ones(1, 2, dtype=torch.bool), times.clone()), max_gap=2.0
    )
    ends = np.array([6.0, 0.0, 0.0])
    views = [
        View(camera(np.array([0.0, 0.1 * (frame - 2), 0.0]), ends, (64, 48)), frame / 4, frame, 0) for frame in range(5)
    ]
    return SceneGraph({"wall": background(rows), "cars": parked}).eval(), views


def test_a_scene_shows_its_wall_without_the_car_and_what_is_behind_it():
    scene, views = scene_of_a_wall()
    lens = replace(views[0].camera, distortion=torch.tensor([-0.2, 0.05, 0.0, 0.0, 0.0]))
    views[0] = replace(views[0], camera=lens)
    mesh = there(surroundings(scene, views, RenderOptions(), VOXEL))
    x, y, z = own(mesh).T
    assert np.quantile(np.abs(x - 6), 0.99) < 0.08
    assert np.hypot(y, z).min() > 0.6
    assert np.ptp(y) > 5
    without = there(surroundings(scene.without("cars"), views, RenderOptions(), VOXEL))
    assert np.hypot(*own(without)[:, 1:].T).min() < VOXEL
    assert surroundings(SceneGraph({"cars": scene.nodes["cars"]}), views, RenderOptions(), VOXEL) is None


def test_more_than_memory_is_meant_to_hold_is_refused(monkeypatch):
    scene, views = scene_of_a_wall()
    with monkeypatch.context() as patch:
        patch.setattr(module, "MAX_BLOCKS", 3)
        with pytest.raises(DemandError, match=r"surfaces in voxels of 0.2 m are \d+ blocks, more than 3: take larger"):
            surroundings(scene, views, RenderOptions(), VOXEL)
    monkeypatch.setattr(module, "MAX_DEPTH_BYTES", 5 * 64 * 48 * 4 - 1)
    with pytest.raises(DemandError, match=r"depths of 5 views are 61,440 bytes"):
        surroundings(scene, views, RenderOptions(), VOXEL)
    for voxel in (0.0, 0.04, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"voxel must lie in \[0.05, 1\] m"):
            surroundings(scene, views, RenderOptions(), voxel)
    with pytest.raises(ValueError, match=r"depths are above 0, got -1"):
        DepthImage(np.full((2, 2), -1, np.float32), views[0].camera)


def test_the_ground_is_left_to_its_own_mesh():
    """Triangles with all corners within 0.3 m of it; a wall keeps its foot, and what is beside the ground stays."""
    ground = Mesh(np.array([[0.0, 0, 5], [0.5, 0, 5.1], [0, 0.5, 5]]), np.array([[0, 1, 2]]))
    vertices = [[0.1, 0, 5.2], [0.3, 0.1, 4.9], [0, 0.3, 5.0], [0.1, 0.1, 5.6], [3, 0, 5], [3.2, 0, 5], [3, 0.2, 5]]
    faces = np.array([[0, 1, 2], [0, 1, 3], [4, 5, 6]])
    left = without_ground(Mesh(np.array(vertices, float), faces), ground)
    assert left.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_array_equal(left.vertices, np.array(vertices)[[0, 1, 3, 4, 5, 6]])
