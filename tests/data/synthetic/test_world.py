"""The street's objects: parts stay in their boxes, poses follow speeds, nobody collides, seeds differ."""

import itertools

import numpy as np
import pytest

from sparsestreet.data.synthetic.models import STYLES, Car, Cyclist, Pedestrian, random_clothes
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import CURB_HEIGHT, CURB_LEFT, CURB_RIGHT, LANES, EgoDrive, Path, build_world

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


@pytest.mark.parametrize(
    ("field", "value"),
    [("num_frames", 0), ("width", -1), ("num_cameras", 4), ("field_of_view", 170.0), ("num_cyclists", -1)],
)
def test_settings_name_what_is_wrong(field, value):
    with pytest.raises(ValueError, match=rf"StreetSettings\.{field} .*{value}"):
        StreetSettings(**{field: value})


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
    with pytest.raises(ValueError, match="limp must be a share from 0 to 1"):
        StreetSettings(limp=1.5)
