"""Culled bundles against brute force over all parts; shadows against hand-computed ones and brute force."""

import numpy as np
import pytest

from sparsestreet.data.synthetic.capture import radiance, to_srgb
from sparsestreet.data.synthetic.shapes import Box, Capsule, Cylinder, Ellipsoid, Polytope, box, extrusion
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


WEDGE = extrusion([(-1.0, -0.5), (1.0, -0.5), (0.6, 0.3), (-0.4, 0.5)], 1.6, 1.0)


def inside_box(p):
    return (np.abs(p) <= np.array([1.0, 0.5, 0.25])[:, None]).all(0)


def inside_ellipsoid(p):
    return ((p / np.array([1.2, 0.6, 0.4])[:, None]) ** 2).sum(0) <= 1


def inside_cylinder(p):
    return (p[0] ** 2 + p[1] ** 2 <= 0.7**2) & (np.abs(p[2]) <= 0.9)


def inside_capsule(p):
    beyond = p[2] - np.clip(p[2], -0.8, 0.8)
    return p[0] ** 2 + p[1] ** 2 + beyond**2 <= 0.45**2


def inside_wedge(p):
    """The four edges of the profile by hand (left of each edge), and |y| below a width linear in z."""
    x, y, z = p
    corners = [(-1.0, -0.5), (1.0, -0.5), (0.6, 0.3), (-0.4, 0.5)]
    inside = np.ones(p.shape[1], bool)
    for (x0, z0), (x1, z1) in zip(corners, corners[1:] + corners[:1], strict=True):
        inside &= (x1 - x0) * (z - z0) - (z1 - z0) * (x - x0) >= 0
    return inside & (np.abs(y) <= 0.8 - 0.3 * (z + 0.5))


SOLIDS = [
    pytest.param(box(2.0, 1.0, 0.5), inside_box, id="box"),
    pytest.param(Ellipsoid(np.array([1.2, 0.6, 0.4], np.float32)), inside_ellipsoid, id="ellipsoid"),
    pytest.param(Cylinder(0.7, 0.9), inside_cylinder, id="cylinder"),
    pytest.param(Capsule(0.45, 0.8), inside_capsule, id="capsule"),
    pytest.param(WEDGE, inside_wedge, id="wedge"),
]


def random_rays(count, seed=3, distance=4.0):
    """Rays from around the solid; about half of them aim at it."""
    rng = np.random.default_rng(seed)
    origins = rng.standard_normal((3, count))
    origins *= distance / np.linalg.norm(origins, axis=0)
    targets = rng.uniform(-0.9, 0.9, (3, count))
    directions = targets - origins
    return origins.astype(np.float32), (directions / np.linalg.norm(directions, axis=0)).astype(np.float32)


@pytest.mark.parametrize(("shape", "inside"), SOLIDS)
def test_entry_matches_a_march_through_the_definition(shape, inside):
    origins, directions = random_rays(301)
    distance = shape.enter(origins, directions)
    step = 1e-3
    marched = np.full(301, np.inf)
    for t in np.arange(0, 8, step)[::-1]:
        marched[inside(origins.astype(np.float64) + t * directions.astype(np.float64))] = t
    hit = np.isfinite(distance)
    assert 60 < hit.sum() < 300
    # A ray that grazes the solid for less than a step may be missed by the march: at most a few of 301.
    assert (hit != np.isfinite(marched)).sum() <= 3
    both = hit & np.isfinite(marched)
    # The march enters up to one step later; 1e-4 is float32 at distance 4 on a grazing ray.
    late = marched[both] - distance[both]
    assert late.min() > -1e-4
    assert np.quantile(late, 0.97) < step + 1e-4
    assert late.max() < 20 * step


@pytest.mark.parametrize(("shape", "inside"), SOLIDS)
def test_normals_point_out_and_extent_contains_the_surface(shape, inside):
    origins, directions = random_rays(301, seed=5)
    distance = shape.enter(origins, directions)
    hit = np.isfinite(distance)
    points = origins[:, hit] + distance[hit] * directions[:, hit]
    normals = shape.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-5)
    assert not inside((points + 1e-3 * normals).astype(np.float64)).any()
    # Steps inwards leave again only across an edge: allow two of the points.
    assert (~inside((points - 1e-3 * normals).astype(np.float64))).sum() <= 2
    assert (np.abs(points) <= shape.half_extent[:, None] + 1e-5).all()


@pytest.mark.parametrize(("shape", "inside"), SOLIDS)
def test_rays_from_inside_and_pointing_away_do_not_hit(shape, inside):
    origins, directions = random_rays(50)
    center = np.zeros((3, 1), np.float32)
    assert np.isinf(shape.enter(center, directions)).all()
    assert np.isinf(shape.enter(origins, -directions)).all()


@pytest.mark.parametrize(("shape", "inside"), SOLIDS)
def test_no_rays(shape, inside):
    none = np.empty((3, 0), np.float32)
    assert shape.enter(none, none).shape == (0,)
    assert shape.normals(none).shape == (3, 0)


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "expected"),
    [
        (box(2.0, 2.0, 2.0), (-5, 0, 0), (1, 0, 0), 4.0),
        (box(2.0, 2.0, 2.0), (-5, 1.5, 0), (1, 0, 0), np.inf),
        (Ellipsoid(np.array([2, 1, 1], np.float32)), (0, -5, 0), (0, 1, 0), 4.0),
        (Ellipsoid(np.array([2, 1, 1], np.float32)), (9, 0, 0), (-1, 0, 0), 7.0),
        (Cylinder(0.5, 1.0), (0, 0, 4), (0, 0, -1), 3.0),
        (Cylinder(0.5, 1.0), (0.6, 0, 4), (0, 0, -1), np.inf),
        (Cylinder(0.5, 1.0), (3, 0, 0), (-1, 0, 0), 2.5),
        (Capsule(0.5, 1.0), (0, 0, 4), (0, 0, -1), 2.5),
        (Capsule(0.5, 1.0), (0, 3, 0.7), (0, -1, 0), 2.5),
        # The half circle of the end: at z = 1.3 the cap's radius is 0.4.
        (Capsule(0.5, 1.0), (0, 3, 1.3), (0, -1, 0), 2.6),
        # A pyramid's side x + z <= 1 met from above at x = 0.25.
        (extrusion([(-1.0, 0.0), (1.0, 0.0), (0.0, 1.0)], 2.0, 2.0), (0.25, 0, 3), (0, 0, -1), 2.25),
    ],
)
def test_hand_computed(shape, origin, direction, expected):
    column = np.array(origin, np.float32)[:, None], np.array(direction, np.float32)[:, None]
    assert shape.enter(*column)[0] == pytest.approx(expected, abs=1e-5)


def test_box_and_polytope_agree():
    sides = np.concatenate((np.eye(3), -np.eye(3))).astype(np.float32)
    half = np.array([1.0, 0.5, 0.25], np.float32)
    polytope = Polytope(sides, np.concatenate((half, half)), half)
    origins, directions = random_rays(200, seed=8)
    np.testing.assert_allclose(
        polytope.enter(origins, directions), Box(half).enter(origins, directions), rtol=1e-5, atol=1e-5
    )
