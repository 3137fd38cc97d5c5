"""Ray intersections against hand-computed cases and against a march through the solids' definitions."""

import numpy as np
import pytest

from sparsestreet.data.synthetic.shapes import Box, Capsule, Cylinder, Ellipsoid, Polytope, box, extrusion

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
