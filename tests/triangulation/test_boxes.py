"""Which features are seen through a box, and which of its points count."""

import numpy as np
import torch

from sparsestreet.triangulation.features import Features
from sparsestreet.triangulation.points import Sighting, TriangulatedPoints
from sparsestreet.triangulation.street import _inside, _through_box
from sparsestreet.types import Track
from tests.triangulation.worlds import descriptors, pose, view

BOX = Track("car", "Car", torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None], torch.tensor([4.0, 2.0, 1.5]))


def test_what_is_behind_the_camera_is_not_seen_through():
    """The box lies at the origin; one camera looks at it from 6 m, the other away from it. Rays: ahead and aside."""
    rays = np.array([[0.0, 0.0], [0.9, 0.0]])
    for place, seen in ((-6.0, [True, False]), (6.0, [False, False])):
        at = pose(z=place)
        features = Features(np.zeros((2, 2)), descriptors(np.random.default_rng(0), 2))
        sighting = Sighting(view(at, 0), at, features, rays, np.zeros((2, 3), np.float32))
        assert _through_box(sighting, BOX).tolist() == seen


def test_points_of_a_box_name_the_views_that_were_given():
    """It was annotated in the views 3, 5 and 8; the second point lies outside of it."""
    positions = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [1.0, 0.5, 0.5]], np.float32)
    observed, views = np.array([0, 0, 1, 2, 2]), np.array([0, 2, 1, 1, 2])
    pixels = np.arange(10, dtype=np.float32).reshape(5, 2)
    points = TriangulatedPoints(positions, positions, positions[:, 0], observed, views, pixels)
    found = _inside(points, [3, 5, 8], BOX)
    assert found.positions.tolist() == positions[[0, 2]].tolist()
    assert found.observed.tolist() == [0, 0, 1, 1]
    assert found.views.tolist() == [3, 8, 5, 8]
    assert found.pixels.tolist() == pixels[[0, 1, 3, 4]].tolist()
