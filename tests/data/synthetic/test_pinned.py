"""The street of a seed stays as it is: recorded numbers name a street by its settings alone.

Who changes the street on purpose takes the numbers that the failing test shows and says so in CHANGELOG.md: what was
measured on earlier streets is then no longer comparable.
"""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic.cameras import street_camera
from sparsestreet.data.synthetic.parts import Part
from sparsestreet.data.synthetic.render import Instant, render_image
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import build_world
from tests.conftest import unchecked
from tests.weighed import weighed

STREET = StreetSettings(seed=2, num_frames=12, num_moving_cars=4, num_pedestrians=4)
OTHER = replace(STREET, seed=7, ego_speed=6.5, frame_rate=4.0, num_parked_cars=9)

PARTS_OF_STREET = {
    "Asphalt": (1, 663.4816, 762.02),
    "BodyPaint": (18, 354.3268, 3535.79),
    "Cabin": (18, 359.2265, 2798.23),
    "Facade": (35, 1417.3514, 3156.64),
    "Footway": (4, 267.2704, 1389.71),
    "Grainy": (197, 4699.0712, 3612.61),
    "Plain": (396, 12691.0529, 13270.08),
    "Wheel": (76, 1178.56, 1341.47),
}
PARTS_OF_OTHER = {
    "Asphalt": (1, 663.4816, 882.48),
    "BodyPaint": (13, 283.47, 3091.95),
    "Cabin": (13, 287.0128, 2569.21),
    "Facade": (34, 1484.9887, 3022.57),
    "Footway": (4, 291.4629, 1406.06),
    "Grainy": (204, 5469.6853, 4315.02),
    "Plain": (384, 12006.6462, 12696.83),
    "Wheel": (56, 903.3599, 1107.63),
}
"""By the kind of surface: the number of parts, their places and sizes, their looks."""


def spread(count: int) -> np.ndarray:
    """Points in the cube of sides 2 around 0, [3, count], evenly spread (Roberts' sequence)."""
    steps = 1.2207440846057596 ** -np.arange(1, 4.0)
    return (2 * (np.arange(1, count + 1) * steps[:, None] % 1) - 1).astype(np.float32)


def looks(part: Part, count: int) -> np.ndarray:
    """Colors and gloss on all sides, as from a few meters: edges are then slopes, not steps."""
    near = np.minimum(part.shape.half_extent, (60.0, 12.0, 60.0))  # of the ground, where the street is
    points = (spread(count) * near[:, None]).astype(np.float32)
    appearance = part.surface.appearance(points, part.shape.normals(points), np.full_like(points, 0.04))
    return np.vstack((appearance.albedo, appearance.gloss[None]))


@pytest.mark.parametrize(
    ("settings", "time", "expected"),
    [(STREET, 0.7, PARTS_OF_STREET), (OTHER, 2.0, PARTS_OF_OTHER)],
    ids=["street", "other"],
)
def test_places_and_looks_of_all_parts(settings, time, expected):
    kinds, found = defaultdict(list), {}
    with unchecked():
        for part in build_world(settings).parts_at(time):
            kinds[type(part.surface).__name__].append(part)
        for kind, parts in kinds.items():
            places = [np.append(part.frame_from_part, (*part.shape.half_extent, part.object_index)) for part in parts]
            seen = [looks(part, 60 + 4000 // len(parts)) for part in parts]
            found[kind] = (len(parts), round(weighed(np.array(places)), 4), round(weighed(np.array(seen)), 2))
    numbers, wanted = (np.array([each[kind] for kind in sorted(found)]) for each in (found, expected))
    # Half extents are float32: 1e-4 of a sum of hundreds. Noise has steps of 0.03 from texel to texel.
    assert (np.abs(numbers - wanted) <= (0, 1e-3, 0.1)).all(), found


@pytest.mark.parametrize(
    ("settings", "camera", "expected"),
    [
        (replace(STREET, width=48, height=30, supersampling=1), 0, 1143.23),
        (replace(OTHER, width=48, height=30, supersampling=2, lens=(0.1, -0.02, 0.001, -0.002, 0.001)), 2, 1076.57),
    ],
    ids=["pinhole", "lens"],
)
def test_light_and_sky_in_a_picture(settings, camera, expected):
    with unchecked():
        world = build_world(settings)
        instant = Instant.at(world, 0.7)
        image = render_image(settings, instant, street_camera(settings, camera, world.ego.pose(0.7)))
    # Of 4,320 values in [0, 1] a few may be rounded to the other side, by 1/255.
    assert weighed(image.rgb / 255) == pytest.approx(expected, abs=0.05)


def test_the_sky_all_around():
    weather = build_world(STREET).weather
    towards = spread(500) / np.linalg.norm(spread(500), axis=0)
    normals = towards[:, ::-1].copy()
    found = weighed(weather.radiance(towards)), weighed(weather.ambient(normals)), weighed(weather.sun)
    assert found == pytest.approx((500.5582, 361.2781, 0.5187), abs=1e-3)
