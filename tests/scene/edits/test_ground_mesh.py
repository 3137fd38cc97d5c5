"""The mesh of a ground that is known: a turned, tilted street far from the world's zero."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.edits import ground as module
from sparsestreet.scene.edits.ground import REACH, SPACING, ground_mesh
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Camera, View
from tests.scene.street import background, random_rows
from tests.typed import there

AHEAD, LEFT = np.array([math.cos(0.6), math.sin(0.6)]), np.array([-math.sin(0.6), math.cos(0.6)])
START = np.array([310.0, -170.0])
SLOPE = np.array([0.04, -0.07])
"""Of x and y of the world."""
HOLE, DEEP = (12.0, 4.5), (24.0, -6.4)
"""Meters ahead and to the left of the start, without Gaussians within 2.1 m and within 4 m."""


def height(places: np.ndarray) -> np.ndarray:
    return 55.0 + (places - START) @ SLOPE


def at(ahead: np.ndarray | float, left: np.ndarray | float) -> np.ndarray:
    return START + np.multiply.outer(ahead, AHEAD) + np.multiply.outer(left, LEFT)


def along(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Meters ahead and to the left of places."""
    return (places - START) @ AHEAD, (places - START) @ LEFT


def rows(places: np.ndarray, heights: np.ndarray, thick: float, seed: int) -> Rows:
    """Flat Gaussians that lie in the slope."""
    made = random_rows(len(places), seed)
    x, y, z, w = Rotation.align_vectors([[-SLOPE[0], -SLOPE[1], 1.0]], [[0.0, 0.0, 1.0]])[0].as_quat()
    with torch.no_grad():
        made.means[:] = torch.from_numpy(np.column_stack([places, heights])).float()
        made.log_scales[:] = torch.tensor([0.3, 0.3, thick]).log()
        made.quaternions[:] = torch.tensor([w, x, y, z])
        made.opacity_logits.fill_(2.0)
    return made


def street() -> SceneGraph:
    """A road 16 m wide and 40 m long that begins 3 m ahead, leaves above it, a deck 0.6 m higher beside it."""
    generator = np.random.default_rng(5)
    road = generator.uniform([3.0, -8.0], [40.0, 8.0], (9000, 2))
    for hole, radius in ((HOLE, 2.15), (DEEP, 4.0)):
        road = road[np.linalg.norm(road - hole, axis=1) > radius]
    deck = generator.uniform([3.0, 9.0], [40.0, 14.0], (4000, 2))
    road, deck = at(road[:, 0], 0.0) + np.outer(road[:, 1], LEFT), at(deck[:, 0], 0.0) + np.outer(deck[:, 1], LEFT)
    noise = generator.normal(0, 0.02, len(road))
    parts = (
        rows(road, height(road) + noise, 0.01, 1),
        rows(deck, height(deck) + 0.6, 0.01, 2),
        rows(road[::3], height(road[::3]) + generator.uniform(3, 9, len(road[::3])), 0.05, 3),
    )
    return SceneGraph({f"part_{number}": background(part) for number, part in enumerate(parts)}).eval()


def views(count: int = 13) -> list[View]:
    """Two cameras, 1.6 m and 1.9 m above the road, each meter of 36; a third that sees no road, 50 m up."""
    made = []
    for frame in range(count):
        for index, (left, up) in enumerate([(0.3, 1.6), (-0.3, 1.9), (0.0, 50.0)]):
            place = at(3.0 * frame, left)
            pose = torch.eye(4)
            pose[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
            pose[:3, 3] = torch.tensor([*place, height(place) + up])
            made.append(View(Camera(inverse(pose), torch.eye(3), 4, 4), frame / count, frame, index))
    return made


@pytest.fixture(scope="module")
def found() -> module.GroundMesh:
    return there(ground_mesh(street(), views()))


def test_the_mesh_is_the_road(found):
    """A slope of 8 % does not bend it; leaves and the deck are not in it."""
    places, heights = found.mesh.vertices[:, :2], found.mesh.vertices[:, 2]
    errors = np.abs(heights - height(places))
    ahead, left = along(places)
    inside = (ahead > 4) & (ahead < 38) & (np.abs(left) < 7)
    area = 34 * 14 - 8.6  # what is left of the second hole 2 m from its edge
    assert inside.sum() * SPACING**2 == pytest.approx(area, rel=0.02)
    assert np.median(errors[inside]) < 0.01
    whole = inside & (np.hypot(ahead - HOLE[0], left - HOLE[1]) > 3) & (np.hypot(ahead - DEEP[0], left - DEEP[1]) > 5)
    assert errors[whole].max() < 0.06
    # Beside the last Gaussians, the height is that of half a circle.
    assert errors.max() < 0.2
    assert left.max() < 9.2
    assert (np.diff(np.sort(np.unique(places[:, 0]))) == SPACING).all()


def test_a_hole_is_filled_where_what_is_around_agrees(found):
    ahead, left = along(found.mesh.vertices[:, :2])
    away = [np.hypot(ahead - hole[0], left - hole[1]) for hole in (HOLE, DEEP)]
    assert away[0].min() < 0.4
    assert 1.7 < away[1].min() < 2.7
    assert found.filled >= 1
    near = REACH * 2 * 36 + np.pi * REACH**2
    assert found.left_out == pytest.approx(near / SPACING**2 - len(found.mesh.vertices), rel=0.05)


def test_where_a_camera_was_driven_the_road_is_as_far_below_it_as_elsewhere(found):
    """Nothing is trained below the first three meters."""
    places = found.mesh.vertices[:, :2]
    ahead, left = along(places)
    first = (ahead < 1) & (np.abs(left) < 1)
    assert first.sum() > 10
    assert ahead.min() > -2.2
    assert np.abs(found.mesh.vertices[first, 2] - height(places[first])).max() < 0.03


def test_a_street_without_a_drive_or_feet_has_no_ground():
    assert ground_mesh(street(), []) is None
    assert ground_mesh(street(), [view for view in views() if view.indices[1] == 2]) is None
    empty = SceneGraph({"sparse": background(random_rows(3, 0))}).eval()
    assert ground_mesh(empty, views()) is None


def test_a_drive_that_spans_more_than_a_square_kilometer_is_told(monkeypatch):
    monkeypatch.setattr(module, "MAX_NODES", 1000)
    with pytest.raises(ValueError, match=r"square kilometer, got \d+ x \d+ m"):
        ground_mesh(street(), views())


def test_smoothing_keeps_slopes_and_walls_and_drops_what_sticks_out():
    rows, columns = np.indices((12, 15), np.float64)
    wall = 0.02 * rows - 0.03 * columns + 0.6 * (columns > 6)
    np.testing.assert_allclose(module._smoothed(wall), wall, atol=1e-12)
    noisy = wall.copy()
    noisy[5, 3] += 0.5
    np.testing.assert_allclose(module._smoothed(noisy), wall, atol=1e-12)
    noisy[5, 3] = np.nan
    np.testing.assert_allclose(module._smoothed(noisy), wall, atol=1e-12)
