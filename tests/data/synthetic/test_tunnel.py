"""A street through a tunnel: no way leads to the sky, and no place looks like another."""

from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic import StreetSettings
from sparsestreet.data.synthetic.render import Instant, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP
from sparsestreet.data.synthetic.tracer import Rays, first_hits, sunlit
from sparsestreet.data.synthetic.world import World, build_world
from tests.conftest import unchecked

SETTINGS = StreetSettings(
    seed=3, num_frames=40, width=48, height=30, supersampling=1, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
    tunnel=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SETTINGS)


@pytest.mark.parametrize("time", [0.0, 3.9])
def test_rays_in_all_directions_hit_it(world, time):
    """Of the upper half of the sphere, from where cameras are at the start and at the end of the drive."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((3, 50, 60))
    directions[2] = np.abs(directions[2])
    directions /= np.linalg.norm(directions, axis=0)
    instant = Instant.at(world, time)
    origin = world.ego.pose(time)[:3, 3] + [1.6, 0.0, 1.65]
    with unchecked():
        hits = first_hits(instant.scene, Rays(origin.astype(np.float32), directions.astype(np.float32)))
    assert np.isfinite(hits.distances).all()
    # No house stands so close: the ceiling is 6.5 m above the road.
    assert hits.distances[directions[2] > 0.9].max() < (6.5 - 1.65) / 0.9 + 0.01


def test_the_sun_shines_nowhere(world):
    instant = Instant.at(world, 0.0)
    rng = np.random.default_rng(0)
    points = rng.uniform((-35, -9, 0), (120, 14, 0), (500, 3)).T.astype(np.float32)
    up = np.repeat(np.array([[0], [0], [1]], np.float32), 500, axis=1)
    with unchecked():
        assert not sunlit(instant.scene, instant.sunlit, points, up, 0).any()
        open_street = Instant.at(build_world(replace(SETTINGS, tunnel=False)), 0.0)
        assert sunlit(open_street.scene, open_street.sunlit, points, up, 0).mean() > 0.2


@pytest.mark.lengthy
def test_pictures_have_contrast_and_no_sky(world):
    with unchecked():
        images = render_frame(SETTINGS, world, 20).images
        street = render_frame(replace(SETTINGS, tunnel=False), build_world(replace(SETTINGS, tunnel=False)), 20).images
    assert not any(image.sky.any() for image in images)
    assert street[0].sky.any()
    for image in images:
        assert 50 < image.rgb.mean() < 180
        assert image.rgb.std() > 15
    # The same cars and people pass as on the street.
    assert set(np.unique(images[0].object_indices)) <= set(range(-1, len(world.actors)))
    assert {actor.name for actor in world.actors} == {
        actor.name for actor in build_world(replace(SETTINGS, tunnel=False)).actors
    }
