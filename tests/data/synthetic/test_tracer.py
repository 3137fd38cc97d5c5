"""Culled bundles against brute force over all parts; shadows against hand-computed ones and brute force."""

import numpy as np
import pytest

from sparsestreet.data.synthetic.capture import radiance, to_srgb
from sparsestreet.data.synthetic.shapes import Capsule, Cylinder, Ellipsoid, box
from sparsestreet.data.synthetic.textures import Plain, random_weather
from sparsestreet.data.synthetic.tracer import NOTHING, Part, Rays, Scene, SunView, at, first_hits, limb, sunlit
from tests.typed import as_a

GRAY = Plain((0.5, 0.5, 0.5))


def random_scene(seed: int) -> Scene:
    """Forty solids around the origin, in all directions."""
    rng = np.random.default_rng(seed)
    shapes = [
        box(2.0, 1.0, 3.0),
        Ellipsoid(np.array([1.5, 0.4, 0.8], np.float32)),
        Cylinder(0.5, 1.2),
        Capsule(0.3, 1.0),
    ]
    parts = [Part(box(400.0, 400.0, 2.0), GRAY, at(0.0, 0.0, -3.0))]
    for number in range(40):
        rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        pose = np.eye(4)
        pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
        pose[:3, 3] = rng.uniform(-20, 20, 3) * [1, 1, 0.2]
        parts.append(Part(shapes[number % 4], GRAY, pose, number))
    return Scene.of(parts)


def brute_force(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to every part, [p, n], through the 4x4 matrices in float64."""
    distances = []
    for part in scene.parts:
        part_from_world = np.linalg.inv(part.frame_from_part)
        local = part_from_world[:3, :3] @ origins + part_from_world[:3, 3:]
        turned = part_from_world[:3, :3] @ directions
        distances.append(part.shape.enter(local.astype(np.float32), turned.astype(np.float32)))
    return np.stack(distances)


def camera_rays(seed: int, height: int = 75, width: int = 131) -> Rays:
    """A wide pinhole looking into a random direction; more than one tile, of odd sizes."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.linspace(-0.6, 0.6, height), np.linspace(-1.1, 1.1, width), indexing="ij")
    rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    directions = np.einsum("ij,jhw->ihw", rotation, np.stack((x, y, np.ones_like(x))))
    directions /= np.linalg.norm(directions, axis=0)
    return Rays(np.array([0.3, -0.2, 0.1], np.float32), directions.astype(np.float32))


def lidar_rays(steps: int) -> Rays:
    """A full turn: cones of rays, which no four planes bound."""
    elevation = np.linspace(-0.5, 0.4, 9)[:, None]
    azimuth = (np.arange(steps) / steps * 2 * np.pi)[None]
    directions = np.stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth)
    )
    return Rays(np.array([0.3, -0.2, 0.1], np.float32), directions.astype(np.float32))


@pytest.mark.parametrize(
    "rays",
    [camera_rays(0), camera_rays(1), camera_rays(2, 1, 1), lidar_rays(200), lidar_rays(5)],
    ids=["camera", "other camera", "one ray", "lidar", "coarse lidar"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_first_hits_equal_brute_force(rays, seed):
    scene = random_scene(seed)
    hits = first_hits(scene, rays)
    directions = rays.directions.reshape(3, -1)
    every = brute_force(scene, rays.origin[:, None].astype(np.float64), directions.astype(np.float64))
    expected = every.min(0)
    found = hits.distances.ravel()
    # Silhouettes: the two ways of rotating a ray differ by 1e-6, so one ray in a thousand may fall on the other side.
    agree = np.isclose(found, expected, rtol=1e-4, atol=1e-4)
    assert agree.mean() > 0.998
    assert ((hits.parts.ravel() == NOTHING) == np.isinf(found)).all()
    sure = agree & np.isfinite(found)
    chosen = every[hits.parts.ravel()[sure], np.flatnonzero(sure)]
    np.testing.assert_allclose(chosen, expected[sure], rtol=1e-4, atol=1e-4)


def test_sunlit_equals_brute_force():
    scene = random_scene(3)
    view = SunView.of(scene, random_weather(2).sun)
    rays = lidar_rays(400)
    hits = first_hits(scene, rays)
    directions, parts = rays.directions.reshape(3, -1), hits.parts.ravel()
    checked = 0
    for index in np.unique(parts[parts != NOTHING]).tolist():
        chosen = np.flatnonzero(parts == index)
        points = rays.origin[:, None] + hits.distances.ravel()[chosen] * directions[:, chosen]
        normals = scene.turn_to_world(index, scene.parts[index].shape.normals(scene.to_part(index, points)))
        lit = sunlit(scene, view, points, normals, index)
        facing = (normals * view.sun[:, None]).sum(0) > 0
        lifted = (points + 2e-3 * normals).astype(np.float64)
        sun = np.repeat(view.sun[:, None].astype(np.float64), len(chosen), axis=1)
        every = brute_force(scene, lifted, sun)
        every[index] = np.inf
        expected = facing & np.isinf(every.min(0))
        assert (lit == expected).mean() > 0.995  # edges of shadows, as above
        checked += int((facing & ~expected).sum())
    assert checked > 50  # there were shadows to be found


def test_shadow_of_a_box_on_the_ground():
    """A box of 2 m, sun from the south at 45 degrees: the shadow reaches 2 m to the north of the box."""
    scene = Scene.of(
        [Part(box(100.0, 100.0, 2.0), GRAY, at(0.0, 0.0, -1.0)), Part(box(2.0, 2.0, 2.0), GRAY, at(0.0, 0.0, 1.0))]
    )
    sun = np.array([0, -1, 1], np.float32) / np.float32(np.sqrt(2))
    points = np.array([[0, 1.5, 0], [0, 2.9, 0], [0, 3.1, 0], [0, -1.5, 0], [0.9, 2, 0], [1.1, 2, 0]], np.float32).T
    up = np.zeros_like(points)
    up[2] = 1
    lit = sunlit(scene, SunView.of(scene, sun), points, up, 0)
    assert lit.tolist() == [False, False, True, True, False, True]


def test_a_point_behind_a_box_is_darker():
    ground, wall = (
        Part(box(100.0, 100.0, 2.0), GRAY, at(0.0, 0.0, -1.0)),
        Part(box(2.0, 2.0, 6.0), GRAY, at(0.0, 0.0, 3.0)),
    )
    weather = random_weather(0)
    behind = -4 * weather.sun / np.linalg.norm(weather.sun[:2])
    x, y = np.array([behind[0], 30.0]), np.array([behind[1], 30.0])  # the second point lies in the open
    brightness = []
    for scene in (Scene.of([ground, wall]), Scene.of([ground])):
        colors = []
        for px, py in zip(x, y, strict=True):
            rays = Rays(np.array([px, py, 5], np.float32), np.array([0, 0, -1], np.float32).reshape(3, 1, 1))
            hits = first_hits(scene, rays)
            colors.append(radiance(scene, SunView.of(scene, weather.sun), weather, rays, hits, 1e-3)[:, 0, 0])
        brightness.append(colors)
    (shaded, open_1), (unshaded, open_2) = brightness
    assert (shaded < 0.5 * unshaded).all()
    np.testing.assert_allclose(open_1, open_2)


def test_srgb_by_hand():
    """Exposure 0.62, then e (1 + e / 4) / (1 + e) * 1.45, then the curve of sRGB: its line, its power, and white."""
    linear = np.array([-0.5, 0.001, 0.5, 0.8, 4.0], np.float32)
    # 0.00062 -> 0.000899 on the line; 0.31 -> 0.369722; 0.496 -> 0.540361; 2.48 -> 1.67, which is cut off.
    expected = [0, 3, 164, 194, 255]
    assert to_srgb(np.tile(linear, (3, 2, 1))).tolist() == [[[value] * 3 for value in expected]] * 2


def test_limb_runs_from_start_to_end():
    part = limb((1.0, 2.0, 3.0), (1.5, 1.0, 4.0), 0.1, GRAY)
    rotation = part.frame_from_part[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    half = as_a(Capsule, part.shape).half_length
    ends = [part.frame_from_part @ [0, 0, z, 1] for z in (-half, half)]
    np.testing.assert_allclose([end[:3] for end in ends], [[1, 2, 3], [1.5, 1, 4]], atol=1e-12)
