"""Streets on which finding what moves is hard: what stops, reverses, is long, fast or close, and sweeps that are bad.

All boxes are known at every frame, whether a lidar sees anything of the object or not.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from sparsestreet.data.synthetic.models import Model
from sparsestreet.data.synthetic.render import sweep
from sparsestreet.data.synthetic.settings import LidarSensor, StreetSettings
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.textures import Plain
from sparsestreet.data.synthetic.tracer import Part, Pose, Scene, at
from sparsestreet.data.synthetic.world import (
    CYCLE_LANE,
    ONCOMING_LANE,
    OVERTAKING_LANE,
    Actor,
    Path,
    Way,
    World,
    build_world,
)
from sparsestreet.tracking.scans import Scan

SPINNING_32 = LidarSensor(
    name="spinning_32",
    elevations=(-30.7, 10.7),
    beams=32,
    azimuth_steps=540,
    max_range=70.0,
    noise=0.02,
    dropout=0.05,
    height=1.84,
)
SMALL = StreetSettings(width=96, height=64, supersampling=1)
"""Images are not looked at; a box needs three returns or some pixels to be annotated."""
MIN_MOVED = 1.0
"""Meters between two boxes of an object that moves."""
ROAD = 0.2
"""Meters above the bottom of a box below which returns may be the road's."""


@dataclass(frozen=True)
class Boxes:
    """The boxes of one object, by frame."""

    name: str
    kind: str
    size: Float64[np.ndarray, "3"]
    poses: Mapping[int, Float64[np.ndarray, "4 4"]]
    returns: Mapping[int, int]

    def corners(self, frame: int) -> Float64[np.ndarray, "4 2"]:
        """Return those of its outline in plan, counterclockwise."""
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        pose = self.poses[frame]
        return pose[:2, 3] + (signs * self.size[:2] / 2) @ pose[:2, :2].T

    @property
    def moves(self) -> bool:
        """Whether any two boxes are far enough apart."""
        places = np.array([pose[:3, 3] for pose in self.poses.values()])
        return bool(np.linalg.norm(places - places[0], axis=1).max() > MIN_MOVED)


def inside(
    points: Float64[np.ndarray, "n 3"], pose: Float64[np.ndarray, "4 4"], size: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Return which points lie in a box, above the road."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return (np.abs(local) <= size / 2).all(1) & (local[:, 2] > ROAD - size[2] / 2)


def boxes_of(
    name: str, kind: str, size: np.ndarray, poses: Mapping[int, np.ndarray], points: Mapping[int, np.ndarray]
) -> Boxes:
    """Return an object with the number of returns in each of its boxes."""
    none = np.zeros((0, 3))
    counts = {frame: int(inside(points.get(frame, none), pose, size).sum()) for frame, pose in poses.items()}
    return Boxes(name, kind, size, poses, counts)


def true_boxes(
    world: World, settings: StreetSettings, scans: Sequence[Scan], scans_from_world: Pose | None = None
) -> list[Boxes]:
    """Return what moves in a synthetic street, with a box at every frame.

    ``scans_from_world`` leads to the axes of the scans, where these are not those of the street.
    """
    turn = np.eye(4) if scans_from_world is None else scans_from_world
    points = points_by_frame(scans)
    times = {frame: frame / settings.frame_rate for frame in range(settings.num_frames)}
    made = []
    for actor in world.actors:
        poses = {frame: turn @ actor.pose(time) for frame, time in times.items()}
        one = boxes_of(actor.name, actor.model.class_name, np.array(actor.model.size), poses, points)
        made += [one] if one.moves else []
    return made


def points_by_frame(scans: Sequence[Scan]) -> dict[int, Float64[np.ndarray, "n 3"]]:
    """Return the returns of all lidars of each frame."""
    by_frame: dict[int, list[np.ndarray]] = {}
    for scan in scans:
        by_frame.setdefault(scan.frame, []).append(scan.points)
    return {frame: np.concatenate(parts) for frame, parts in by_frame.items()}


@dataclass(frozen=True)
class Paced(Way):
    """A way at another pace: time runs ``pace`` times as fast, linearly between knots; below 0 it leads back."""

    base: Way
    knots: tuple[tuple[float, float], ...]
    """(seconds, pace); before the first and after the last the pace stays."""

    def _warped(self, time: float) -> float:
        times, paces = np.array(self.knots).T
        between = times[(times > 0) & (times < time)]
        own = np.concatenate(([0.0], between, [time]))
        return float(np.trapezoid(np.interp(own, times, paces), own))

    def traveled(self, time: float) -> float:
        return self.base.traveled(self._warped(time))

    def pose(self, time: float, height: float) -> Pose:
        return self.base.pose(self._warped(time), height)


@dataclass(frozen=True)
class Carriage:
    """A truck or a tram: a box."""

    size: tuple[float, float, float]
    class_name = "Vehicle"

    def parts(self, traveled: float) -> list[Part]:
        """Return the box, which stands 0.3 m above the road."""
        length, width, height = self.size
        return [Part(box(length, width, height - 0.3), Plain((0.3, 0.3, 0.35)), at(0.0, 0.0, 0.15))]


def named(world: World, word: str) -> list[Actor]:
    """Return the actors whose names begin with a word."""
    return [actor for actor in world.actors if actor.name.startswith(word)]


def without(world: World, *words: str) -> tuple[Actor, ...]:
    """Return the actors whose names begin with none of these words."""
    return tuple(actor for actor in world.actors if not actor.name.startswith(words))


def paced(actor: Actor, *knots: tuple[float, float]) -> Actor:
    """Return an actor at another pace."""
    return replace(actor, path=Paced(actor.path, knots))


def place_at(world: World, time: float) -> float:
    """Return x of the recording car, meters."""
    return float(world.ego.pose(time)[0, 3])


def stops(world: World) -> World:
    """One car stops and goes on, one stops for good, a parked one pulls out, and a person waits."""
    moving, people = named(world, "moving"), named(world, "pedestrian")
    parked = [actor for actor in named(world, "parked") if 12 < actor.pose(0)[0, 3] < 45]
    leaves = parked[len(parked) // 2]
    x, y = leaves.pose(0)[:2, 3]
    ahead = float(np.sign(leaves.pose(0)[0, 0]))
    way = Path(x, y, 6.0 * ahead, shift=3.0 * (1 if y < 0 else -1), shift_time=2.0)
    changed = (
        replace(leaves, path=Paced(way, ((2.2, 0.0), (3.7, 1.0)))),
        paced(moving[0], (0.8, 1.0), (2.3, 0.0), (3.2, 0.0), (4.7, 1.0)),
        paced(moving[1], (2.0, 1.0), (3.5, 0.0)),
        paced(people[0], (1.5, 1.0), (1.8, 0.0), (3.5, 0.0), (3.8, 1.0)),
    )
    rest = without(world, "moving", people[0].name, leaves.name)
    return replace(world, actors=(*rest, *changed))


def fast(world: World) -> World:
    """Two oncoming cars at 25 m/s."""
    changed = []
    for number, (actor, meeting) in enumerate(zip(named(world, "moving"), (1.5, 2.9), strict=False)):
        start = place_at(world, meeting) + 25 * meeting
        changed.append(replace(actor, name=f"fast_{number}", path=Path(start, ONCOMING_LANE, -25.0)))
    return replace(world, actors=(*without(world, "moving"), *changed))


def long(world: World) -> World:
    """An oncoming tram of 23 m, a truck of 12 m that is passed, and one of 9 m that drives ahead."""
    tram, truck, van = (23.0, 2.6, 3.4), (12.0, 2.5, 3.3), (9.0, 2.45, 3.2)
    changed = (
        long_one("tram", tram, Path(place_at(world, 2.2) + 5 * 2.2, ONCOMING_LANE, -5.0)),
        long_one("truck", truck, Path(14.0, OVERTAKING_LANE, 4.0)),
        long_one("van", van, Path(24.0, 0.0, 8.5)),
    )
    return replace(world, actors=(*without(world, "moving"), *changed))


def long_one(name: str, size: tuple[float, float, float], way: Way) -> Actor:
    """Return a long thing on the road."""
    model: Model = Carriage(size)
    return Actor(name, model, way, 0.0)


def close(world: World) -> World:
    """Two people pass 0.9 m from each other, two meet, stand and go back, and a car passes a cyclist."""
    people, moving = named(world, "pedestrian"), named(world, "moving")
    x, beside = place_at(world, 2.0) + 10, place_at(world, 2.0) + 4
    ways = (
        Path(x - 2.4, 5.0, 1.2),
        Path(x + 2.4, 5.9, -1.2),
        Paced(Path(beside + 14, 8.2, 1.2), ((1.6, 1.0), (1.9, 0.0), (2.5, 0.0), (2.8, -1.0))),
        Paced(Path(beside + 19, 8.4, -1.2), ((1.6, 1.0), (1.9, 0.0), (2.5, 0.0), (2.8, -1.0))),
    )
    changed = [replace(actor, path=way, ground=0.0) for actor, way in zip(people, ways, strict=False)]
    rider = named(world, "cyclist")[0]
    passes = replace(moving[1], path=Path(rider.pose(2)[0, 3] - 2 * 12.0, CYCLE_LANE + 1.9, 12.0))
    rest = without(world, "moving", *(actor.name for actor in changed))
    return replace(world, actors=(*rest, *changed, passes))


def back(world: World) -> World:
    """One car reverses all the time, and one drives on, stops and reverses."""
    moving = named(world, "moving")
    x = place_at(world, 2.0)
    changed = (
        replace(moving[0], path=Paced(Path(x + 16, ONCOMING_LANE, -3.0), ((0.0, -1.0),))),
        replace(moving[1], path=Paced(Path(x - 4, OVERTAKING_LANE, 6.0), ((1.2, 1.0), (2.2, -0.6)))),
    )
    return replace(world, actors=(*without(world, "moving"), *changed))


Seen = tuple[list[Scan], list[Boxes]]
"""What lidars saw, and what was there."""
Mounts = Sequence[tuple[float, float]]
"""x and y of lidars on the recording car, meters."""
OneLidar: Mounts = ((0.0, 0.0),)


def recorded(world: World, settings: StreetSettings, mounts: Mounts = OneLidar) -> Seen:
    """Return the sweeps of a street, each of one instant."""
    scans = []
    for frame in range(settings.num_frames):
        time = frame / settings.frame_rate
        scene, ego = Scene.of(world.parts_at(time)), world.ego.pose(time)
        for number, (x, y) in enumerate(mounts):
            turn = sweep(settings, scene, ego @ at(x, y, 0.0), frame + 1000 * number)
            points = turn.points[:, :3].astype(np.float64) @ turn.world_from_lidar[:3, :3].T
            origin = np.array(turn.world_from_lidar[:3, 3], np.float64)
            scans.append(Scan(frame, time, points + origin, origin))
    return scans, true_boxes(world, settings, scans)


SECTORS = 8
"""Parts of a turn, each of one instant: what drives 10 m/s jumps by 0.13 m from one to the next."""


def spun(world: World, settings: StreetSettings) -> Seen:
    """Return sweeps of a lidar that turns while things move; the middle of its turn is the time of its boxes."""
    scans = []
    for frame in range(settings.num_frames):
        parts, origins, middle = [], [], frame / settings.frame_rate
        for sector in range(SECTORS):
            time = middle + ((sector + 0.5) / SECTORS - 0.5) / settings.frame_rate
            turn = sweep(settings, Scene.of(world.parts_at(time)), world.ego.pose(time), frame)
            local = turn.points[:, :3].astype(np.float64)
            part = np.floor((np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) + 0.5) * SECTORS) == sector
            parts.append(local[part] @ turn.world_from_lidar[:3, :3].T + turn.world_from_lidar[:3, 3])
            origins.append(turn.world_from_lidar[:3, 3])
        scans.append(Scan(frame, middle, np.concatenate(parts), np.mean(origins, axis=0)))
    return scans, true_boxes(world, settings, scans)


def tilted(seen: Seen) -> Seen:
    """Return a street whose world is turned by 140 degrees, tilted by 4 and far from its origin."""
    yaw, tilt = at(0.0, 0.0, 0.0, np.radians(140)), np.eye(4)
    angle = np.radians(4)
    tilt[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    turn = at(1200.0, -700.0, 85.0) @ tilt @ yaw
    scans, truth = seen
    moved = [
        replace(
            scan, points=scan.points @ turn[:3, :3].T + turn[:3, 3], origin=turn[:3, :3] @ scan.origin + turn[:3, 3]
        )
        for scan in scans
    ]
    return moved, [replace(one, poses={frame: turn @ pose for frame, pose in one.poses.items()}) for one in truth]


def shaken(seen: Seen, meters: float, degrees: float, seed: int) -> Seen:
    """Return sweeps with poses that are off by so much along and about each axis, standard deviation."""
    scans, truth = seen
    random = np.random.default_rng(seed)
    moved = []
    for scan in scans:
        shift, turn = random.normal(0, meters, 3), np.radians(random.normal(0, degrees, 3))
        away = scan.points - scan.origin
        # Of so small a turn the sine is the angle, within 1e-5.
        moved.append(replace(scan, points=scan.points + np.cross(turn, away) + shift, origin=scan.origin + shift))
    return moved, truth


NOISE = ((0.02, 0.05), (0.05, 0.1), (0.1, 0.2))
"""Meters and degrees by which poses are off."""


def hard_streets(seeds: Sequence[int]) -> dict[str, Callable[[], Seen]]:
    """Return what makes each hard street, by name."""
    made: dict[str, Callable[[], Seen]] = {}
    for seed in seeds:
        settings = replace(SMALL, seed=seed)
        slow = replace(settings, num_frames=60)
        for change, own in ((stops, slow), (fast, settings), (long, slow), (close, settings), (back, slow)):
            made[f"{change.__name__}_{seed}"] = partial(_changed, change, own)
        made[f"two_lidars_{seed}"] = partial(_two_lidars, settings)
        made[f"spun_{seed}"] = partial(_spun, settings)
        made[f"tilted_{seed}"] = partial(_tilted, settings)
        for meters, degrees in NOISE:
            made[f"poses_{100 * meters:.0f}_cm_{degrees}_{seed}"] = partial(_shaken, settings, meters, degrees)
    return made


def _changed(change: Callable[[World], World], settings: StreetSettings) -> Seen:
    return recorded(change(build_world(settings)), settings)


def _two_lidars(settings: StreetSettings) -> Seen:
    own = replace(settings, lidar=SPINNING_32)
    return recorded(build_world(own), own, ((0.6, 0.7), (-1.4, -0.7)))


def _spun(settings: StreetSettings) -> Seen:
    return spun(build_world(settings), settings)


def _tilted(settings: StreetSettings) -> Seen:
    return tilted(recorded(build_world(settings), settings))


def _shaken(settings: StreetSettings, meters: float, degrees: float) -> Seen:
    return shaken(recorded(build_world(settings), settings), meters, degrees, settings.seed)
