"""Which features are seen through a box, and which of its points count."""

from dataclasses import replace

import numpy as np
import torch

from sparsestreet.triangulation.matches import Features
from sparsestreet.triangulation.points import Sighting, TriangulatedPoints
from sparsestreet.triangulation.street import _from_box, _inside, _through_box
from sparsestreet.types import Track
from tests.triangulation.worlds import descriptors, pose, view
from tests.typed import there

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


def test_a_box_is_where_it_is_when_the_image_is_taken():
    """The box drives 2 m from frame 0 to frame 1; the image of frame 0 is taken a quarter of the way."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 2.0
    times = torch.tensor([0.0, 0.8], dtype=torch.float64)
    track = replace(BOX, frames=torch.tensor([0, 1]), world_from_object=poses, times=times)
    at = pose(z=-6.0)
    features = Features(np.zeros((0, 2)), descriptors(np.random.default_rng(0), 0))
    seen = replace(view(at, 0), time=0.2)
    sighting = Sighting(seen, at, features, np.zeros((0, 2)), np.zeros((0, 3), np.float32))
    moved = there(_from_box(sighting, track)).camera_from_frame @ np.linalg.inv(at)
    np.testing.assert_allclose(moved[:3, 3], at[:3, :3] @ (0.5, 0, 0), atol=1e-12)
    assert _from_box(replace(sighting, view=replace(seen, frame_index=2)), track) is None
