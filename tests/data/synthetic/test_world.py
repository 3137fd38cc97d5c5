"""The street's objects: parts stay in their boxes, poses follow speeds, nobody collides, seeds differ."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sparsestreet.data.synthetic.capture import radiance, street_camera
from sparsestreet.data.synthetic.models import STYLES, Car, Cyclist, Pedestrian, random_clothes
from sparsestreet.data.synthetic.render import Instant, render_frame
from sparsestreet.data.synthetic.settings import WAYMO_TOP, StreetSettings
from sparsestreet.data.synthetic.tracer import NOTHING, Part, Rays, first_hits, sunlit
from sparsestreet.data.synthetic.world import (
    CURB_HEIGHT,
    CURB_LEFT,
    CURB_RIGHT,
    LANES,
    EgoDrive,
    Path,
    World,
    build_world,
)
from tests.conftest import unchecked

CLOTHES = random_clothes(np.random.default_rng(0))
GRAY = (0.5, 0.5, 0.5)
MODELS = [
    *(Car(style, GRAY, GRAY) for style in STYLES),
    Pedestrian(1.58, CLOTHES),
    Pedestrian(1.9, CLOTHES),
    Cyclist(CLOTHES, GRAY),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.class_name} {model.size[0]:.2f}")
def test_parts_stay_within_the_box_and_nearly_fill_it(model):
    reach = np.zeros(3)
    rng = np.random.default_rng(0)
    for traveled in np.linspace(0, 6.3, 13):
        for part in model.parts(float(traveled)):
            directions = rng.standard_normal((3, 300))
            directions /= np.linalg.norm(directions, axis=0)
            # Rays towards a point within the part, from all around: their entries sample its surface.
            origins = -4 * directions
            hit = part.shape.enter(origins.astype(np.float32), directions.astype(np.float32))
            points = (origins + np.where(np.isfinite(hit), hit, 4.0) * directions)[:, np.isfinite(hit)]
            world = part.frame_from_part[:3, :3] @ points + part.frame_from_part[:3, 3:]
            reach = np.maximum(reach, np.abs(world).max(1))
    half = np.array(model.size) / 2
    assert (reach <= half + 1e-3).all(), reach - half
    assert (reach >= 0.75 * half).all(), reach / half


def test_wheels_touch_the_road():
    for style in STYLES:
        car = Car(style, GRAY, GRAY)
        lowest = min(part.frame_from_part[2, 3] - part.shape.half_extent[0] for part in car.parts(0.0)[2:])
        assert lowest == pytest.approx(-style.height / 2, abs=1e-6)


def test_path_heading_is_the_tangent():
    path = Path(start=3.0, y=7.0, speed=-9.0, shift=2.0, shift_time=1.5)
    for time in (0.0, 0.7, 1.5, 2.2, 4.0):
        ahead, behind = np.array(path.position(time + 1e-5)), np.array(path.position(time - 1e-5))
        tangent = (ahead - behind) / 2e-5
        heading = path.heading(time)
        expected = np.array([np.cos(heading), np.sin(heading)]) * np.linalg.norm(tangent)
        np.testing.assert_allclose(expected, tangent, atol=1e-4)


def test_a_car_turns_to_both_sides_and_stays_in_its_lane():
    """The heading swings by 15 degrees once in 4 s: at most 15 pi / 2 = 24 degrees a second, and the speed's part."""
    ego, times = EgoDrive(8.0, 15.0), np.arange(0, 4, 0.01)
    poses = np.stack([ego.pose(time) for time in times])
    headings = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    rates = np.diff(headings) / 0.01
    assert 14 < headings.max() < 17
    assert -17 < headings.min() < -14
    assert (np.abs(rates) > 15).mean() > 0.5
    assert 22 < np.abs(rates).max() < 28
    assert np.abs(poses[:, 1, 3]).max() < 1.75
    # The way along the street, which meetings with other cars follow from, stays what it was.
    np.testing.assert_array_equal(poses[:, 0, 3], [EgoDrive(8.0).pose(time)[0, 3] for time in times])


@pytest.mark.parametrize("turn", [0.0, 15.0])
def test_ego_heading_is_the_tangent(turn):
    ego = EgoDrive(8.0, turn)
    for time in (0.0, 1.3, 3.9):
        tangent = (ego.pose(time + 1e-5)[:2, 3] - ego.pose(time - 1e-5)[:2, 3]) / 2e-5
        forward = ego.pose(time)[:2, 0]
        np.testing.assert_allclose(tangent / np.linalg.norm(tangent), forward, atol=1e-4)
        assert 6 < np.linalg.norm(tangent) < 10


@pytest.mark.lengthy
@pytest.mark.parametrize(
    "settings",
    [
        StreetSettings(seed=0),
        StreetSettings(seed=1),
        StreetSettings(seed=2, num_frames=5, num_moving_cars=9, num_cyclists=4),
        StreetSettings(seed=3, num_frames=30, frame_rate=2.0, num_moving_cars=12, num_parked_cars=30),
    ],
    ids=["seed 0", "seed 1", "crowded", "long"],
)
def test_moving_actors_travel_at_their_speed_and_nobody_collides(settings):
    world = build_world(settings)
    ego_half = np.array([2.4, 1.0])
    for frame in range(settings.num_frames):
        time = frame / settings.frame_rate
        centers = [actor.pose(time)[:2, 3] for actor in world.actors]
        halves = [np.array(actor.model.size[:2]) / 2 for actor in world.actors]
        forward = world.ego.pose(time) @ [1.3, 0, 0, 1]
        for center, half in zip(centers, halves, strict=True):
            # Headings stay within a few degrees of the street's, so boxes overlap only if both intervals do.
            assert (np.abs(center - forward[:2]) > half + ego_half).any()
        for a, b in itertools.combinations(range(len(centers)), 2):
            assert (np.abs(centers[a] - centers[b]) > halves[a] + halves[b]).any(), (frame, a, b)
        for actor in world.actors:
            assert isinstance(actor.path, Path)
            moved = np.linalg.norm(actor.pose(time + 0.1)[:2, 3] - actor.pose(time)[:2, 3])
            assert moved >= abs(actor.path.speed) * 0.1 - 1e-9
            assert moved <= abs(actor.path.speed) * 0.1 * 1.15 + 1e-9
    kinds = [actor.name.split("_")[0] for actor in world.actors]
    counts = [kinds.count(kind) for kind in ("parked", "moving", "pedestrian", "cyclist")]
    wanted = [settings.num_parked_cars, settings.num_moving_cars, settings.num_pedestrians, settings.num_cyclists]
    assert counts == wanted


def test_people_walk_on_footways_and_cars_on_the_road():
    world = build_world(StreetSettings(seed=5))
    for actor in world.actors:
        y = actor.pose(1.0)[1, 3]
        on_road = CURB_RIGHT < y < CURB_LEFT
        assert on_road == (actor.model.class_name != "Pedestrian")
        bottom = actor.pose(1.0)[2, 3] - actor.model.size[2] / 2
        assert bottom == pytest.approx(0.0 if on_road else CURB_HEIGHT, abs=1e-9)


def test_a_crowd_crosses_close_before_the_car_and_waits_beside_the_lanes():
    settings = StreetSettings(seed=3, num_crossing=9, num_frames=60, num_moving_cars=0, num_cyclists=0)
    world = build_world(settings)
    crowd = [actor for actor in world.actors if actor.name.startswith("crossing")]
    assert len(crowd) == 9
    times = np.linspace(0, settings.duration, 601)
    ego = np.array([world.ego.pose(time)[0, 3] for time in times])
    for actor in crowd:
        y = np.array([actor.pose(time)[1, 3] for time in times])
        middle = np.abs(y) < 0.05  # in the middle of the car's lane, where it has it 6 to 10 m ahead
        ahead = actor.pose(0.0)[0, 3] - ego[middle]
        # 0.05 m take a walker of 0.9 m/s 0.06 s, in which the car drives half a meter.
        assert middle.any()
        assert 5.4 < ahead.min() <= ahead.max() < 10.6
        assert LANES[0] - 1e-9 <= y.min()
        assert y.max() <= LANES[1] + 1e-9
        steps = np.abs(np.diff(y)) * 600 / settings.duration
        walks = steps > 1e-6
        assert 0.8 < np.median(steps[walks]) < 1.7
        # Legs move with the way: none is walked standing.
        np.testing.assert_allclose(
            np.diff([actor.path.traveled(time) for time in times]), np.abs(np.diff(y)), atol=1e-9
        )
        forward = actor.pose(0.0)[:3, 0]
        assert forward[1] * (y[-1] - y[0]) > 0.99 * abs(y[-1] - y[0]) > 0


@pytest.mark.lengthy
def test_seeds_give_other_streets_and_counts_can_be_zero():
    first, again, other = (build_world(StreetSettings(seed=seed)) for seed in (0, 0, 1))
    poses = [[actor.pose(0.0) for actor in world.actors] for world in (first, again, other)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert not np.allclose(poses[0], poses[2])
    assert [part.surface for part in first.scenery] != [part.surface for part in other.scenery]
    empty = StreetSettings(num_parked_cars=0, num_moving_cars=0, num_pedestrians=0, num_cyclists=0, num_frames=1)
    assert build_world(empty).actors == ()


def test_who_limps_swings_the_right_limbs_less():
    """Over a stride of 1.4 m: feet and hands keep their middle, and the right ones a fourth of their reach."""
    walked = np.linspace(0, 1.4, 29)
    reach = {}
    for limp in (0.0, 0.75):
        person = Pedestrian(1.75, CLOTHES, limp=limp)
        for side in (-1, 1):
            feet, hands = (np.array([limb(side, s)[2][0] for s in walked]) for limb in (person.leg, person.arm))
            reach[limp, side] = np.ptp(feet), np.ptp(hands)
    np.testing.assert_allclose(reach[0.75, -1], np.array(reach[0.0, -1]) / 4, rtol=1e-9)
    assert reach[0.75, 1] == reach[0.0, 1] == pytest.approx(reach[0.0, -1])
    walkers = [actor.model for actor in build_world(StreetSettings(limp=0.75)).actors]
    assert {model.limp for model in walkers if isinstance(model, Pedestrian)} == {0.75}


TUNNEL = StreetSettings(
    seed=3, num_frames=40, width=48, height=30, supersampling=1, lidar=replace(WAYMO_TOP, beams=2, azimuth_steps=16),
    tunnel=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def tunnel_world() -> World:
    return build_world(TUNNEL)


@pytest.mark.parametrize("time", [0.0, 3.9])
def test_rays_in_all_directions_hit_it(tunnel_world, time):
    """Of the upper half of the sphere, from where cameras are at the start and at the end of the drive."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((3, 50, 60))
    directions[2] = np.abs(directions[2])
    directions /= np.linalg.norm(directions, axis=0)
    instant = Instant.at(tunnel_world, time)
    origin = tunnel_world.ego.pose(time)[:3, 3] + [1.6, 0.0, 1.65]
    with unchecked():
        hits = first_hits(instant.scene, Rays(origin.astype(np.float32), directions.astype(np.float32)))
    assert np.isfinite(hits.distances).all()
    # No house stands so close: the ceiling is 6.5 m above the road.
    assert hits.distances[directions[2] > 0.9].max() < (6.5 - 1.65) / 0.9 + 0.01


def test_the_sun_shines_nowhere(tunnel_world):
    instant = Instant.at(tunnel_world, 0.0)
    rng = np.random.default_rng(0)
    points = rng.uniform((-35, -9, 0), (120, 14, 0), (500, 3)).T.astype(np.float32)
    up = np.repeat(np.array([[0], [0], [1]], np.float32), 500, axis=1)
    with unchecked():
        assert not sunlit(instant.scene, instant.sunlit, points, up, 0).any()
        open_street = Instant.at(build_world(replace(TUNNEL, tunnel=False)), 0.0)
        assert sunlit(open_street.scene, open_street.sunlit, points, up, 0).mean() > 0.2


@pytest.mark.lengthy
def test_pictures_have_contrast_and_no_sky(tunnel_world):
    with unchecked():
        images = render_frame(TUNNEL, tunnel_world, 20).images
        street = render_frame(replace(TUNNEL, tunnel=False), build_world(replace(TUNNEL, tunnel=False)), 20).images
    assert not any(image.sky.any() for image in images)
    assert street[0].sky.any()
    for image in images:
        assert 50 < image.rgb.mean() < 180
        assert image.rgb.std() > 15
    # The same cars and people pass as on the street.
    assert set(np.unique(images[0].object_indices)) <= set(range(-1, len(tunnel_world.actors)))
    assert {actor.name for actor in tunnel_world.actors} == {
        actor.name for actor in build_world(replace(TUNNEL, tunnel=False)).actors
    }


FROZEN = StreetSettings(seed=0, num_frames=2)


@pytest.fixture(scope="module")
def frozen_world() -> World:
    return build_world(FROZEN)


@pytest.fixture(scope="module")
def parts(frozen_world) -> dict[str, list[Part]]:
    """The street's parts by the kind of their surface, while everybody moves."""
    kinds: dict[str, list[Part]] = {}
    for part in frozen_world.parts_at(0.7):
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


def test_the_light_is_what_it_was(frozen_world):
    """Mean and spread of linear RGB of 300 rays to all sides of the first camera, and of what stands in their way."""
    instant = Instant.at(frozen_world, 0.7)
    angle, z = np.meshgrid(np.linspace(0.0, 2 * np.pi, 25), np.linspace(-0.35, 0.6, 12))
    flat = np.sqrt(1 - z**2)
    directions = np.stack((flat * np.cos(angle), flat * np.sin(angle), z)).astype(np.float32)
    place = street_camera(FROZEN, 0, frozen_world.ego.pose(0.7)).world_from_camera[:3, 3].astype(np.float32)
    rays = Rays(place, directions)
    hits = first_hits(instant.scene, rays)
    colors = radiance(instant.scene, instant.sunlit, instant.weather, rays, hits, 1e-3).astype(np.float64)
    hit = hits.parts != NOTHING
    found = [*colors.mean((1, 2)), *colors.std((1, 2)), hit.mean(), np.log(hits.distances[hit]).mean()]
    # One ray of 300 that an edge turns aside moves a mean by 1e-3 or so.
    assert found == pytest.approx(LIGHT, rel=2e-3)
