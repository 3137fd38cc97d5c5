"""The street of a seed stays what it was: recorded results are of it.

Sizes, colors, and places of a street have no other oracle than their author. Whoever changes them on purpose runs this
file, takes its numbers over, and measures anew what docs/ says of streets.
"""

import numpy as np
import pytest

from sparsestreet.data.synthetic.capture import radiance, street_camera
from sparsestreet.data.synthetic.render import Instant
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.tracer import NOTHING, Part, Rays, first_hits
from sparsestreet.data.synthetic.world import World, build_world

SETTINGS = StreetSettings(seed=0, num_frames=2)


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SETTINGS)


@pytest.fixture(scope="module")
def parts(world) -> dict[str, list[Part]]:
    """The street's parts by the kind of their surface, while everybody moves."""
    kinds: dict[str, list[Part]] = {}
    for part in world.parts_at(0.7):
        kinds.setdefault(type(part.surface).__name__, []).append(part)
    return kinds


PLACES = {
    "Asphalt": [1, 800.0, 800.0, 0.0, 800.0, 800.0, 0.0],
    "Footway": [4, 95.800002, 11.2, 0.1275, 95.800002, 24.197521, 0.127525],
    "Facade": [32, 47.037016, 10.431185, 14.09406, 65.859894, 22.02163, 14.268085],
    "Plain": [310, 34.092398, 4.001295, 5.932295, 50.349049, 12.964722, 7.524783],
    "Grainy": [204, 34.535738, 2.542125, 4.699096, 43.470651, 9.636423, 5.116],
    "BodyPaint": [19, 20.646265, 3.435356, 0.988947, 26.631835, 6.530061, 0.992602],
    "Cabin": [19, 20.725236, 3.43811, 1.621579, 26.738858, 6.558913, 1.637278],
    "Wheel": [80, 20.625096, 3.18375, 0.0, 26.450953, 7.065893, 0.0],
}


def test_parts_are_where_they_were(parts):
    """Count, and mean and root mean square of one corner of each part's box."""
    found = {}
    for kind, members in parts.items():
        corners = np.array([part.frame_from_part @ [*part.shape.half_extent.tolist(), 1.0] for part in members])[:, :3]
        found[kind] = [len(members), *corners.mean(0), *np.sqrt((corners**2).mean(0))]
    # Meters in float64, written with 6 decimals.
    assert found == {kind: pytest.approx(numbers, rel=0, abs=1e-6) for kind, numbers in PLACES.items()}


SHAPES = {
    "Asphalt": [1.0, 3.091373],
    "Footway": [1.0, 3.0349867],
    "Facade": [1.0, 2.1450735],
    "Plain": [0.9792473, 2.808603],
    "Grainy": [0.9022876, 2.3916891],
    "BodyPaint": [0.9973684, 2.6922105],
    "Cabin": [0.8315789, 2.756082],
    "Wheel": [0.968125, 2.4639672],
}


def test_shapes_are_what_they_were(parts):
    """Share of rays towards the inside of each part's box that hit it, and how far they come."""
    rng = np.random.default_rng(0)
    found = {}
    for kind, members in parts.items():
        distances = []
        for part in members:
            half = part.shape.half_extent.astype(np.float64)
            starts = rng.standard_normal((3, 60))
            starts *= 3 * half.max() / np.linalg.norm(starts, axis=0)
            towards = rng.uniform(-0.9, 0.9, (3, 60)) * half[:, None] - starts
            directions = towards / np.linalg.norm(towards, axis=0)
            distances.append(part.shape.enter(starts.astype(np.float32), directions.astype(np.float32)) / half.max())
        values = np.concatenate(distances).astype(np.float64)
        hit = np.isfinite(values)
        found[kind] = [hit.mean(), values[hit].mean()]
    # Float32 distances, whose errors even out; a ray may meet an edge in another way.
    assert found == {kind: pytest.approx(numbers, rel=2e-6) for kind, numbers in SHAPES.items()}


LOOKS = {
    "Asphalt": [0.129871, 0.167372, 0.099082, 0.0, 0.111338, 0.104878, 0.118715, 0.0],
    "Footway": [0.271543, 0.265023, 0.247042, 0.0, 0.072215, 0.070513, 0.069096, 0.0],
    "Facade": [0.322728, 0.277972, 0.245513, 0.116395, 0.179197, 0.170896, 0.15894, 0.281737],
    "Plain": [0.319914, 0.285347, 0.266813, 0.025161, 0.214917, 0.212516, 0.195052, 0.071926],
    "Grainy": [0.208263, 0.231707, 0.069033, 0.0, 0.146967, 0.1249, 0.055731, 0.0],
    "BodyPaint": [0.183277, 0.142611, 0.173634, 0.299338, 0.202535, 0.18027, 0.178515, 0.122445],
    "Cabin": [0.119591, 0.096211, 0.117688, 0.556911, 0.16745, 0.14043, 0.146462, 0.22284],
    "Wheel": [0.038293, 0.038293, 0.038318, 0.018747, 0.073204, 0.073204, 0.073309, 0.065064],
}


def test_surfaces_look_as_they_did(parts):
    """Mean and spread of color and gloss, of every kind of surface, at 48 places on all sides of each part's box."""
    rng = np.random.default_rng(0)
    sides = np.concatenate((np.eye(3), -np.eye(3))).astype(np.float32)
    found = {}
    for kind, members in parts.items():
        looks = []
        for part in members:
            normals = sides[np.arange(48) % 6].T
            half = part.shape.half_extent[:, None]
            inside = rng.uniform(-1, 1, (3, 48)).astype(np.float32) * np.minimum(half, 15)
            points = np.where(normals == 0, inside, normals * half)
            seen = part.surface.appearance(points, normals, np.full_like(points, 0.004))
            looks.append(np.concatenate((seen.albedo, seen.gloss[None])))
        values = np.concatenate(looks, 1).astype(np.float64)
        found[kind] = [*values.mean(1), *values.std(1)]
    # Float32, and a point on the edge of a pattern may fall on its other side.
    assert found == {kind: pytest.approx(numbers, rel=2e-4, abs=1e-5) for kind, numbers in LOOKS.items()}


LIGHT = [0.25838, 0.24638, 0.26999, 0.22518, 0.22048, 0.237, 0.84, 2.42166]


def test_the_light_is_what_it_was(world):
    """Mean and spread of linear RGB of 300 rays to all sides of the first camera, and of what stands in their way."""
    instant = Instant.at(world, 0.7)
    angle, z = np.meshgrid(np.linspace(0.0, 2 * np.pi, 25), np.linspace(-0.35, 0.6, 12))
    flat = np.sqrt(1 - z**2)
    directions = np.stack((flat * np.cos(angle), flat * np.sin(angle), z)).astype(np.float32)
    place = street_camera(SETTINGS, 0, world.ego.pose(0.7)).world_from_camera[:3, 3].astype(np.float32)
    rays = Rays(place, directions)
    hits = first_hits(instant.scene, rays)
    colors = radiance(instant.scene, instant.sunlit, instant.weather, rays, hits, 1e-3).astype(np.float64)
    hit = hits.parts != NOTHING
    found = [*colors.mean((1, 2)), *colors.std((1, 2)), hit.mean(), np.log(hits.distances[hit]).mean()]
    # One ray of 300 that an edge turns aside moves a mean by 1e-3 or so.
    assert found == pytest.approx(LIGHT, rel=2e-3)
