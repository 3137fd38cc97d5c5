"""Build the street: places and motions of all things, decided by the seed."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.models import (
    Model,
    bin_box,
    house,
    lamp_post,
    random_car,
    random_cyclist,
    random_pedestrian,
    tree,
)
from sparsestreet.data.synthetic.settings import TURNS, StreetSettings, swing
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.textures import (
    Asphalt,
    Color,
    Footway,
    Grainy,
    Lines,
    Plain,
    Vectors,
    Weather,
    column,
    mix,
    random_weather,
    stream,
)
from sparsestreet.data.synthetic.tracer import Part, Pose, at, placed

EGO_LANE = 0.0
OVERTAKING_LANE = 3.5
ONCOMING_LANE = 7.0
CYCLE_LANE = -2.55
LANES = (-3.0, 8.6)
"""From the right side of the lanes to their left, between the parked cars."""
PARKING_RIGHT = -4.45
PARKING_LEFT = 10.0

CURB_RIGHT = -5.6
CURB_LEFT = 11.2
FOOTWAY_WIDTH = 3.6
CURB_HEIGHT = 0.13

SOLID_LINES = (-1.75, -3.35, 5.15, 5.40, 8.75)
DASHED_LINES = (1.75,)

BEHIND = 40.0
"""The street starts this many meters behind the first frame."""
AHEAD = 95.0
"""The street ends this many meters after the last frame."""


_HEIGHT = 6.5
"""Meters from the road to the ceiling."""
_THICKNESS = 2.0
_LAMP: Color = (2.2, 2.1, 1.8)
"""A lamp shines: its color is above what a surface reflects."""
_LIGHT_ABOVE, _LIGHT_BELOW = (0.80, 0.74, 0.62), (0.42, 0.39, 0.34)


@dataclass(frozen=True)
class TunnelLight(Weather):
    """Light of lamps: from above and from the pale road, the same everywhere; the ceiling shades all from the sun."""

    def radiance(self, directions: Vectors) -> Vectors:
        """Return what is mirrored: the ceiling, brighter straight above."""
        return mix(column(_LIGHT_BELOW), column(_LIGHT_ABOVE), np.maximum(directions[2], np.float32(0)))

    def ambient(self, normals: Vectors) -> Vectors:
        return mix(column(_LIGHT_BELOW), column(_LIGHT_ABOVE), np.float32(0.5) + np.float32(0.5) * normals[2])


def tunnel(seed: int, end: float) -> list[Part]:
    """Return walls on both sides, a ceiling and two ends around a drive of ``end`` meters, closed on all sides."""
    rng = stream(seed, "tunnel")
    start, stop = -BEHIND, end + AHEAD
    right, left = CURB_RIGHT - FOOTWAY_WIDTH, CURB_LEFT + FOOTWAY_WIDTH
    length, width = stop - start, left - right
    middle, center = (start + stop) / 2, (left + right) / 2
    long, wide, thick = length + 2 * _THICKNESS, width + 2 * _THICKNESS, _THICKNESS
    concrete = Grainy((0.42, 0.40, 0.37), 1.3, 0.16, float(rng.uniform(0.0, 20.0)))
    side, face = box(long, thick, _HEIGHT + thick), box(thick, wide, _HEIGHT + thick)
    half, up = thick / 2, (_HEIGHT + thick) / 2
    parts = [Part(box(long, wide, thick), concrete, at(middle, center, _HEIGHT + half))]
    parts += [Part(side, concrete, at(middle, y, up)) for y in (right - half, left + half)]
    parts += [Part(face, concrete, at(x, center, up)) for x in (start - half, stop + half)]
    return parts + _fittings(rng, start, stop, right, left)


def _fittings(rng: np.random.Generator, start: float, stop: float, right: float, left: float) -> list[Part]:
    """Return lamps, tiles, pillars, doors and signs: what tells one place of a tunnel from another."""
    tiles = ((0.62, 0.60, 0.52), (0.50, 0.55, 0.58), (0.55, 0.44, 0.30), (0.30, 0.38, 0.42))
    doors = ((0.05, 0.32, 0.12), (0.45, 0.08, 0.05), (0.08, 0.16, 0.40))
    parts, pitch = [], 5.0
    for x in np.arange(start + pitch / 2, stop, pitch).tolist():
        parts += [Part(box(1.4, 0.35, 0.12), Plain(_LAMP), at(x, y, _HEIGHT - 0.06)) for y in (0.0, 7.0)]
        for wall, inwards in ((right, 1), (left, -1)):
            tile = np.array(tiles[rng.integers(len(tiles))]) * rng.uniform(0.85, 1.1)
            surface = Grainy(tuple(tile.tolist()), 0.5, 0.12, float(rng.uniform(0.0, 20.0)))
            parts.append(Part(box(pitch - 0.3, 0.1, 2.6), surface, at(x, wall + 0.02 * inwards, 1.7)))
            pillar = Grainy((0.30, 0.29, 0.28), 0.4, 0.15, float(rng.uniform(0.0, 20.0)))
            parts.append(Part(box(0.5, 0.5, _HEIGHT), pillar, at(x + pitch / 2, wall, _HEIGHT / 2)))
            if rng.random() < 0.4:
                place = x + float(rng.uniform(-1, 1))
                door = Plain(doors[rng.integers(len(doors))], 0.1)
                parts.append(Part(box(1.1, 0.12, 2.1), door, at(place, wall + 0.06 * inwards, 1.2)))
                sign = Plain((0.05, 0.45, 0.18) if rng.random() < 0.5 else (0.6, 0.6, 0.55))
                parts.append(Part(box(0.9, 0.08, 0.45), sign, at(place, wall + 0.1 * inwards, 3.6)))
    return parts


class Way(ABC):
    """Where a thing is over time."""

    @abstractmethod
    def traveled(self, time: float) -> float:
        """Return meters that its wheels or legs have moved since time 0."""

    @abstractmethod
    def pose(self, time: float, height: float) -> Pose:
        """Return world from object, with the object's origin ``height`` meters above the road."""


@dataclass(frozen=True)
class Path(Way):
    """x = start + speed t; y moves by ``shift`` around ``shift_time`` (world frame, meters and seconds).

    >>> Path(start=5.0, y=1.0, speed=2.0).position(3.0)
    (11.0, 1.0)
    """

    start: float
    y: float
    speed: float
    """Signed speed along x, meters per second; a thing with speed 0 has the heading ``rest_heading``."""
    shift: float = 0.0
    shift_time: float = 0.0
    shift_duration: float = 2.5
    rest_heading: float = 0.0

    def position(self, time: float) -> tuple[float, float]:
        s = self._phase(time)
        return self.start + self.speed * time, self.y + self.shift * (s * s * (3 - 2 * s))

    def heading(self, time: float) -> float:
        """Return the angle of the path's tangent from +x, radians."""
        if self.speed == 0:
            return self.rest_heading
        s = self._phase(time)
        sideways = self.shift * 6 * s * (1 - s) / self.shift_duration
        return float(np.arctan2(sideways, self.speed))

    def traveled(self, time: float) -> float:
        """Return meters along x since time 0; the sideways part would turn wheels by less than a percent."""
        return abs(self.speed) * time

    def pose(self, time: float, height: float) -> Pose:
        return at(*self.position(time), height, self.heading(time))

    def _phase(self, time: float) -> float:
        return float(np.clip((time - self.shift_time) / self.shift_duration + 0.5, 0, 1))


@dataclass(frozen=True)
class Crossing(Way):
    """Waits at one side of the lanes, walks straight across and stands at the other (world frame, meters and seconds).

    >>> Crossing(x=5.0, start=-3.0, end=8.0, speed=2.0, at=1.0).position(2.0)
    (5.0, -1.0)
    """

    x: float
    start: float
    end: float
    """y of the two sides."""
    speed: float
    """Meters per second."""
    at: float
    """When it leaves, seconds."""

    def position(self, time: float) -> tuple[float, float]:
        return self.x, self.start + float(np.copysign(self.traveled(time), self.end - self.start))

    def traveled(self, time: float) -> float:
        return float(np.clip(self.speed * (time - self.at), 0, abs(self.end - self.start)))

    def pose(self, time: float, height: float) -> Pose:
        return at(*self.position(time), height, float(np.copysign(np.pi / 2, self.end - self.start)))


@dataclass(frozen=True)
class EgoDrive:
    """The recording car. It drives at y = 0 on average, sways a little and changes its speed slowly."""

    speed: float
    turn: float = 0.0
    """Degrees, of its weaving within the lane (``StreetSettings.turn``)."""

    def pose(self, time: float) -> Pose:
        """Return world from ego: x forward, y left, z up, origin on the road under the rear axle."""
        x = self.speed * (time + 0.15 * np.sin(0.9 * time))
        y = 0.12 * np.sin(0.8 * time)
        sideways = 0.12 * 0.8 * np.cos(0.8 * time)
        if self.turn:
            weave = swing(self.speed, self.turn)
            y, sideways = y + weave * np.sin(TURNS * time), sideways + weave * TURNS * np.cos(TURNS * time)
        slope = sideways / (self.speed * (1 + 0.15 * 0.9 * np.cos(0.9 * time)))
        return at(float(x), float(y), 0.0, float(np.arctan(slope)))


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
        """Return world from object; the object's origin is the center of its box."""
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
        """Return all parts in the world frame at a time in seconds."""
        parts = list(self.scenery)
        for index, actor in enumerate(self.actors):
            parts += placed(actor.model.parts(actor.path.traveled(time)), actor.pose(time), index)
        return parts


def build_world(settings: StreetSettings) -> World:
    ego = EgoDrive(settings.ego_speed, settings.turn)
    end = settings.ego_speed * settings.duration
    seed = settings.seed
    beside = tunnel(seed, end) if settings.tunnel else [*_houses(seed, end), *_footway_things(seed, end)]
    weather = random_weather(seed)
    if settings.tunnel:
        weather = TunnelLight(**vars(weather))
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
    start, stop = -BEHIND, end + AHEAD
    lines = Lines(
        solid=SOLID_LINES,
        dashed=DASHED_LINES,
        crossings=(_crossing(seed, end), stop - 12),
        curb_right=CURB_RIGHT,
        curb_left=CURB_LEFT,
    )
    gray = float(rng.uniform(0.09, 0.15))
    asphalt = Asphalt(lines, (gray, gray, gray * 1.03), float(rng.uniform(0, 30)))
    parts = [Part(box(1600.0, 1600.0, 2.0), asphalt, at(0.0, 0.0, -1.0))]
    half, half_length = FOOTWAY_WIDTH / 2, (stop - start) / 2
    tone = float(rng.uniform(0.24, 0.34))
    for side, curb in ((1, CURB_RIGHT), (-1, CURB_LEFT)):
        footway = Footway((tone, tone * 0.97, tone * 0.91), half, side, float(rng.uniform(0, 30)))
        # Sunk into the ground, and wider at the back, so that set-back houses leave no gap to the road surface.
        solid = box(2 * half_length, 2 * half, 2 * CURB_HEIGHT)
        parts.append(Part(solid, footway, at((start + stop) / 2.0, curb - side * half, 0.0)))
        back = Footway((tone * 0.9, tone * 0.88, tone * 0.8), 50.0, side, float(rng.uniform(0, 30)))
        yard = box(2 * half_length, 30.0, 2 * CURB_HEIGHT - 0.01)
        parts.append(Part(yard, back, at((start + stop) / 2.0, curb - side * (2 * half + 15.0), 0.0)))
    return parts


def _crossing(seed: int, end: float) -> float:
    """Return x of the near end of the zebra crossing."""
    return float(stream(seed, "crossing").uniform(0.35, 0.6)) * end + 16


def _houses(seed: int, end: float) -> list[Part]:
    """Return two rows of houses along the street, with a few gaps, and a row across its end."""
    rng = stream(seed, "houses")
    stop = end + AHEAD
    fronts = ((1, CURB_RIGHT - FOOTWAY_WIDTH), (-1, CURB_LEFT + FOOTWAY_WIDTH))
    parts: list[Part] = []
    for road_side, front in fronts:
        x = -BEHIND + float(rng.uniform(-6, 0))
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
    y = CURB_RIGHT - 12.0
    while y < CURB_LEFT + 12:
        width = float(rng.uniform(9, 14))
        # Turned by a quarter, so that the front looks back along the street.
        parts += placed(house(rng, width, 10.0, 1), at(stop + 14.0, y + width / 2.0, 0.0, np.pi / 2.0))
        y += width
    return parts


def _footway_things(seed: int, end: float) -> list[Part]:
    """Return trees, lamp posts and bins in turn along both curbs."""
    rng = stream(seed, "footway")
    parts: list[Part] = []
    for side, y in ((1, CURB_RIGHT - 0.75), (-1, CURB_LEFT + 0.75)):
        x, turn = -12.0 + float(rng.uniform(0, 6)), int(rng.integers(3))
        while x < end + AHEAD - 15:
            is_lamp = turn % 3 == 2
            thing = lamp_post(side) if is_lamp else tree(rng)
            parts += placed(thing, at(x, y, CURB_HEIGHT))
            if rng.random() < 0.25:
                parts += placed(bin_box(rng), at(x + 1.6, y, CURB_HEIGHT))
            x, turn = x + float(rng.uniform(6.5, 10)), turn + 1
    return parts


def _parked_cars(settings: StreetSettings, end: float) -> list[Actor]:
    """Return cars in random places of both parking strips, most of them where the drive passes."""
    rng = stream(settings.seed, "parked cars")
    spacing = 6.4
    places = [
        # Nobody parks on the crossing, so the places beyond it start one crossing later.
        (x + 9.0 * (x > _crossing(settings.seed, end) - 4), y, heading)
        for y, heading, shift in ((PARKING_RIGHT, 0.0, -1.0), (PARKING_LEFT, np.pi, 2.0))
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
    """Return oncoming and overtaking cars in turn. Each kind shares a speed and keeps a distance, so none collide."""
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
            speed, lane, wanted = oncoming, ONCOMING_LANE, beside - oncoming * meeting
            start = max(wanted + 6, last[speed] + spacing)
            shift, shift_time = float(rng.uniform(-0.5, 0.5)), meeting
        else:
            speed, lane, wanted = overtaking, OVERTAKING_LANE, beside - overtaking * meeting
            start = min(wanted, last[speed] - spacing)
            # Back into the ego lane once well ahead.
            shift, shift_time = EGO_LANE - OVERTAKING_LANE, meeting + 14 / (speed - settings.ego_speed)
        last[speed] = start
        path = Path(start, lane + float(rng.uniform(-0.2, 0.2)), speed, shift, shift_time)
        actors.append(Actor(f"moving_{number:02d}", random_car(rng), path, 0.0))
    return actors


def _pedestrians(settings: StreetSettings, end: float) -> list[Actor]:
    """Return people on both footways, each on their own line between the trees and the houses."""
    rng = stream(settings.seed, "pedestrians")
    actors = []
    for number in range(settings.num_pedestrians):
        on_right = number % 2 == 0
        lane = float(rng.uniform(1.3, 2.9))
        y = CURB_RIGHT - lane if on_right else CURB_LEFT + lane
        speed = float(rng.uniform(0.9, 1.6)) * (1 if rng.random() < 0.5 else -1)
        share = (number + float(rng.uniform(0.2, 0.8))) / settings.num_pedestrians
        path = Path(start=6 + share * (end + 18.0), y=y, speed=speed)
        actors.append(Actor(f"pedestrian_{number:02d}", random_pedestrian(rng, settings.limp), path, CURB_HEIGHT))
    return actors


def _crowd(settings: StreetSettings, ego: EgoDrive) -> list[Actor]:
    """Return people who cross the street before the ego car, from both sides in turn, and heed no other car."""
    rng = stream(settings.seed, "crowd")
    actors = []
    for number in range(settings.num_crossing):
        # When they are in the middle of the ego lane, spread evenly over the drive, and how far ahead of the car.
        time = settings.duration * (number + float(rng.uniform(0.2, 0.8))) / settings.num_crossing
        x = float(ego.pose(time)[0, 3]) + float(rng.uniform(*CROSSING_AHEAD))
        speed = float(rng.uniform(0.9, 1.6))
        start, end = LANES if number % 2 == 0 else LANES[::-1]
        path = Crossing(x, start, end, speed, time - abs(start - EGO_LANE) / speed)
        actors.append(Actor(f"crossing_{number:02d}", random_pedestrian(rng, settings.limp), path, 0.0))
    return actors


def _cyclists(settings: StreetSettings) -> list[Actor]:
    """Return cyclists in a row at one speed, in the lane to the right of the ego car, which passes them."""
    rng = stream(settings.seed, "cyclists")
    speed = settings.ego_speed * float(rng.uniform(0.5, 0.65))
    actors = []
    for number in range(settings.num_cyclists):
        path = Path(9 + 8 * number + float(rng.uniform(0.0, 4.0)), CYCLE_LANE + float(rng.uniform(-0.2, 0.2)), speed)
        actors.append(Actor(f"cyclist_{number:02d}", random_cyclist(rng), path, 0.0))
    return actors
