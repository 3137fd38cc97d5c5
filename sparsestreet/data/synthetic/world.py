"""The street itself: the places and motions of all things, decided by the seed."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic import layout
from sparsestreet.data.synthetic.models.car import random_car
from sparsestreet.data.synthetic.models.model import Model
from sparsestreet.data.synthetic.models.people import random_cyclist, random_pedestrian
from sparsestreet.data.synthetic.models.roadside import bin_box, house, lamp_post, tree
from sparsestreet.data.synthetic.motion import Crossing, EgoDrive, Path, Way
from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.parts import Part, Pose, at, placed
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.sky import Weather, random_weather
from sparsestreet.data.synthetic.textures.ground import Asphalt, Footway, Lines
from sparsestreet.data.synthetic.tunnel import tunnel, tunnel_light

CROSSING_AHEAD = (6.0, 10.0)
"""Meters from the ego car's rear axle to people who cross its lane, least and most."""


@dataclass(frozen=True)
class Actor:
    """An annotated object and its path."""

    name: str
    model: Model
    path: Way
    ground: float
    """Height of the ground under it, meters."""

    def pose(self, time: float) -> Pose:
        """Returns world from object; the object's origin is the center of its box."""
        return self.path.pose(time, self.ground + self.model.size[2] / 2)


@dataclass(frozen=True)
class World:
    ego: EgoDrive
    scenery: tuple[Part, ...]
    """Parts of everything but annotated objects, in the world frame."""
    actors: tuple[Actor, ...]
    """Annotated objects; an actor's position in this tuple is the object index of its parts."""
    weather: Weather

    def parts_at(self, time: float) -> list[Part]:
        """Returns all parts in the world frame at a time in seconds."""
        parts = list(self.scenery)
        for index, actor in enumerate(self.actors):
            parts += placed(actor.model.parts(actor.path.traveled(time)), actor.pose(time), index)
        return parts


def build_world(settings: StreetSettings) -> World:
    ego = EgoDrive(settings.ego_speed, settings.turn)
    end = settings.ego_speed * settings.duration
    seed = settings.seed
    beside = tunnel(seed, end) if settings.tunnel else [*_houses(seed, end), *_footway_things(seed, end)]
    weather = tunnel_light(seed) if settings.tunnel else random_weather(seed)
    actors = [
        *_parked_cars(settings, end),
        *_moving_cars(settings, ego),
        *_pedestrians(settings, end),
        *_crowd(settings, ego),
        *_cyclists(settings),
    ]
    return World(ego, (*_ground(seed, end), *beside), tuple(actors), weather)


def _ground(seed: int, end: float) -> list[Part]:
    rng = stream(seed, "ground")
    start, stop = -layout.BEHIND, end + layout.AHEAD
    lines = Lines(
        solid=layout.SOLID_LINES,
        dashed=layout.DASHED_LINES,
        crossings=(_crossing(seed, end), stop - 12),
        curb_right=layout.CURB_RIGHT,
        curb_left=layout.CURB_LEFT,
    )
    gray = float(rng.uniform(0.09, 0.15))
    asphalt = Asphalt(lines, (gray, gray, gray * 1.03), float(rng.uniform(0, 30)))
    parts = [Part(box(1600.0, 1600.0, 2.0), asphalt, at(0.0, 0.0, -1.0))]
    half, half_length = layout.FOOTWAY_WIDTH / 2, (stop - start) / 2
    tone = float(rng.uniform(0.24, 0.34))
    for side, curb in ((1, layout.CURB_RIGHT), (-1, layout.CURB_LEFT)):
        footway = Footway((tone, tone * 0.97, tone * 0.91), half, side, float(rng.uniform(0, 30)))
        # Sunk into the ground, and wider at the back, so that set-back houses leave no gap to the road surface.
        solid = box(2 * half_length, 2 * half, 2 * layout.CURB_HEIGHT)
        parts.append(Part(solid, footway, at((start + stop) / 2.0, curb - side * half, 0.0)))
        back = Footway((tone * 0.9, tone * 0.88, tone * 0.8), 50.0, side, float(rng.uniform(0, 30)))
        yard = box(2 * half_length, 30.0, 2 * layout.CURB_HEIGHT - 0.01)
        parts.append(Part(yard, back, at((start + stop) / 2.0, curb - side * (2 * half + 15.0), 0.0)))
    return parts


def _crossing(seed: int, end: float) -> float:
    """Returns x of the near end of the zebra crossing."""
    return float(stream(seed, "crossing").uniform(0.35, 0.6)) * end + 16


def _houses(seed: int, end: float) -> list[Part]:
    """Returns two rows of houses along the street, with a few gaps, and a row across its end."""
    rng = stream(seed, "houses")
    stop = end + layout.AHEAD
    fronts = ((1, layout.CURB_RIGHT - layout.FOOTWAY_WIDTH), (-1, layout.CURB_LEFT + layout.FOOTWAY_WIDTH))
    parts: list[Part] = []
    for road_side, front in fronts:
        x = -layout.BEHIND + float(rng.uniform(-6, 0))
        while x < stop:
            width = float(rng.uniform(8, 15))
            setback = float(rng.uniform(0.0, 0.6))
            pose = at(x + width / 2.0, front - road_side * setback, 0.0)
            parts += placed(house(rng, width, float(rng.uniform(9, 13)), road_side), pose)
            x += width
            if rng.random() < 0.2:
                gap = float(rng.uniform(3, 6))
                behind = house(rng, gap + 10.0, 10.0, road_side)
                parts += placed(behind, at(x + gap / 2.0, front - road_side * 15.0, 0.0))
                x += gap
    y = layout.CURB_RIGHT - 12.0
    while y < layout.CURB_LEFT + 12:
        width = float(rng.uniform(9, 14))
        # Turned by a quarter, so that the front looks back along the street.
        parts += placed(house(rng, width, 10.0, 1), at(stop + 14.0, y + width / 2.0, 0.0, np.pi / 2.0))
        y += width
    return parts


def _footway_things(seed: int, end: float) -> list[Part]:
    """Returns trees, lamp posts and bins in turn along both curbs."""
    rng = stream(seed, "footway")
    parts: list[Part] = []
    for side, y in ((1, layout.CURB_RIGHT - 0.75), (-1, layout.CURB_LEFT + 0.75)):
        x, turn = -12.0 + float(rng.uniform(0, 6)), int(rng.integers(3))
        while x < end + layout.AHEAD - 15:
            is_lamp = turn % 3 == 2
            thing = lamp_post(side) if is_lamp else tree(rng)
            parts += placed(thing, at(x, y, layout.CURB_HEIGHT))
            if rng.random() < 0.25:
                parts += placed(bin_box(rng), at(x + 1.6, y, layout.CURB_HEIGHT))
            x, turn = x + float(rng.uniform(6.5, 10)), turn + 1
    return parts


def _parked_cars(settings: StreetSettings, end: float) -> list[Actor]:
    """Returns cars in random places of both parking strips, most of them where the drive passes."""
    rng = stream(settings.seed, "parked cars")
    spacing = 6.4
    places = [
        # Nobody parks on the crossing, so the places beyond it start one crossing later.
        (x + 9.0 * (x > _crossing(settings.seed, end) - 4), y, heading)
        for y, heading, shift in ((layout.PARKING_RIGHT, 0.0, -1.0), (layout.PARKING_LEFT, np.pi, 2.0))
        for x in shift + spacing * np.arange(max(int((end + 36) / spacing), (settings.num_parked_cars + 1) // 2))
    ]
    chosen = sorted(rng.choice(len(places), size=settings.num_parked_cars, replace=False))
    actors = []
    for number, place in enumerate(chosen):
        x, y, heading = places[place]
        path = Path(
            start=x + float(rng.uniform(-0.4, 0.4)),
            y=y + float(rng.uniform(-0.12, 0.12)),
            speed=0.0,
            rest_heading=heading + float(rng.uniform(-0.03, 0.03)),
        )
        actors.append(Actor(f"parked_{number:02d}", random_car(rng), path, 0.0))
    return actors


def _moving_cars(settings: StreetSettings, ego: EgoDrive) -> list[Actor]:
    """Returns oncoming and overtaking cars in turn. Each kind shares a speed and keeps a distance, so none collide."""
    rng = stream(settings.seed, "moving cars")
    oncoming, overtaking = -float(rng.uniform(8, 11)), settings.ego_speed + float(rng.uniform(3.5, 5))
    spacing = 11.0
    last = {oncoming: -np.inf, overtaking: np.inf}
    actors = []
    for number in range(settings.num_moving_cars):
        # Times when the cars pass the ego car, spread evenly over the drive.
        meeting = settings.duration * (number + 0.7) / max(settings.num_moving_cars, 1)
        beside = float(ego.pose(meeting)[0, 3])
        if number % 2 == 0:
            speed, lane, wanted = oncoming, layout.ONCOMING_LANE, beside - oncoming * meeting
            start = max(wanted + 6, last[speed] + spacing)
            shift, shift_time = float(rng.uniform(-0.5, 0.5)), meeting
        else:
            speed, lane, wanted = overtaking, layout.OVERTAKING_LANE, beside - overtaking * meeting
            start = min(wanted, last[speed] - spacing)
            # Back into the ego lane once well ahead.
            shift, shift_time = layout.EGO_LANE - layout.OVERTAKING_LANE, meeting + 14 / (speed - settings.ego_speed)
        last[speed] = start
        path = Path(start, lane + float(rng.uniform(-0.2, 0.2)), speed, shift, shift_time)
        actors.append(Actor(f"moving_{number:02d}", random_car(rng), path, 0.0))
    return actors


def _pedestrians(settings: StreetSettings, end: float) -> list[Actor]:
    """Returns people on both footways, each on their own line between the trees and the houses."""
    rng = stream(settings.seed, "pedestrians")
    actors = []
    for number in range(settings.num_pedestrians):
        on_right = number % 2 == 0
        lane = float(rng.uniform(1.3, 2.9))
        y = layout.CURB_RIGHT - lane if on_right else layout.CURB_LEFT + lane
        speed = float(rng.uniform(0.9, 1.6)) * (1 if rng.random() < 0.5 else -1)
        share = (number + float(rng.uniform(0.2, 0.8))) / settings.num_pedestrians
        path = Path(start=6 + share * (end + 18.0), y=y, speed=speed)
        actors.append(
            Actor(f"pedestrian_{number:02d}", random_pedestrian(rng, settings.limp), path, layout.CURB_HEIGHT)
        )
    return actors


def _crowd(settings: StreetSettings, ego: EgoDrive) -> list[Actor]:
    """Returns people who cross the street before the ego car, from both sides in turn, and heed no other car."""
    rng = stream(settings.seed, "crowd")
    actors = []
    for number in range(settings.num_crossing):
        # When they are in the middle of the ego lane, spread evenly over the drive, and how far ahead of the car.
        time = settings.duration * (number + float(rng.uniform(0.2, 0.8))) / settings.num_crossing
        x = float(ego.pose(time)[0, 3]) + float(rng.uniform(*CROSSING_AHEAD))
        speed = float(rng.uniform(0.9, 1.6))
        start, end = layout.LANES if number % 2 == 0 else layout.LANES[::-1]
        path = Crossing(x, start, end, speed, time - abs(start - layout.EGO_LANE) / speed)
        actors.append(Actor(f"crossing_{number:02d}", random_pedestrian(rng, settings.limp), path, 0.0))
    return actors


def _cyclists(settings: StreetSettings) -> list[Actor]:
    """Returns cyclists in a row at one speed, in the lane to the right of the ego car, which passes them."""
    rng = stream(settings.seed, "cyclists")
    speed = settings.ego_speed * float(rng.uniform(0.5, 0.65))
    actors = []
    for number in range(settings.num_cyclists):
        path = Path(
            9 + 8 * number + float(rng.uniform(0.0, 4.0)), layout.CYCLE_LANE + float(rng.uniform(-0.2, 0.2)), speed
        )
        actors.append(Actor(f"cyclist_{number:02d}", random_cyclist(rng), path, 0.0))
    return actors
