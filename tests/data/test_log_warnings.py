"""Faults planted into a crooked log: turned and shifted world, cameras that fire apart, a gap in frames."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog, VehiclePath
from sparsestreet.data.log_warnings import contradictions
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Camera, Frame, SparsePoints, Sweep, Track
from tests.evidence import wall

INSTANTS = [0, 1, 2, 3, 5, 6, 7, 8, 9, 10]
"""Number 4 is missing."""
ORIGIN = torch.tensor([451_234.567, 5_412_345.678, 321.09], dtype=torch.float64)
LAST = 1.04
"""Seconds; the second camera fires 40 ms after the first."""
CAR, BIKE = (4.6, 1.9, 1.5), (1.8, 0.7, 1.6)


def rigid(yaw: float, at: tuple[float, float, float], pitch: float = 0.0) -> Tensor:
    """Rotation about z after one about y, degrees."""
    pose = torch.eye(4, dtype=torch.float64)
    turns = torch.tensor([[0.0, 0.0, math.radians(yaw)], [0.0, math.radians(pitch), 0.0]], dtype=torch.float64)
    about_z, about_y = quat.to_matrix(quat.from_rotation_vector(turns))
    pose[:3, :3], pose[:3, 3] = about_z @ about_y, torch.tensor(at, dtype=torch.float64)
    return pose


WORLD = rigid(41.0, (3.0, -2.0, 0.7), 3.0)
"""world_from_street: street x ahead, y left, z up from the road."""
AXES = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""vehicle_from_camera, without the way to the camera."""


def vehicle(seconds: float) -> Tensor:
    """world_from_vehicle: 8 m/s, in a wide bend."""
    return WORLD @ rigid(4.0 * seconds, (8.0 * seconds, 0.28 * seconds**2, 0.0))


def camera(seconds: float, number: int) -> Camera:
    mount = rigid(20.0 * number, (1.5, 0.3 * number, 1.6)) @ AXES
    intrinsics = torch.tensor([[50.0, 0, 39.0], [0, 50.0, 27.0], [0, 0, 1]])
    return Camera(inverse(vehicle(seconds) @ mount).float(), intrinsics, 80, 50)


def frames() -> list[Frame]:
    """A colored pattern that moves on from image to image."""
    coarse = torch.randint(0, 256, (1, 3, 10, 60), generator=torch.Generator().manual_seed(1)).float()
    pattern = torch.nn.functional.interpolate(coarse, (50, 300), mode="bilinear")[0].permute(1, 2, 0)
    made = []
    for instant in INSTANTS:
        for number in (0, 1):
            seconds = 0.1 * instant + 0.04 * number
            image = pattern[:, 12 * instant + 40 * number :][:, :80].to(torch.uint8)
            stamp = 1_700_000_000_000_000_000 + round(1e9 * seconds)
            made.append(Frame(camera(seconds, number), seconds / LAST, instant, number, seconds, stamp, image=image))
    return made


def track(name: str, kind: str, size: tuple[float, float, float], at: Callable[[float], Tensor]) -> Track:
    """Of an object, world_from_street times ``at`` (seconds), whose floor is the road."""
    poses = torch.stack([WORLD @ at(0.1 * instant) @ rigid(0, (0, 0, size[2] / 2)) for instant in INSTANTS])
    times = torch.tensor(INSTANTS, dtype=torch.float64) * 0.1 / LAST
    return Track(name, kind, torch.tensor(INSTANTS), poses, torch.tensor(size), times=times)


TRACKS = (
    track("moving", "car", CAR, lambda seconds: rigid(5.0, (14 + 9 * seconds, 3.5, 0))),
    track("parked", "car", CAR, lambda seconds: rigid(0.0, (22.0, -4.0, 0))),
    track("across", "car", CAR, lambda seconds: rigid(100.0, (30.0, 1.0, 0))),
    track("bike", "cyclist", BIKE, lambda seconds: rigid(-30.0, (12 + 4 * seconds, -2.0, 0))),
)


def points(instant: int, place: int) -> Tensor:
    """The road, and sides and roofs of what the boxes hold."""
    draw = torch.Generator().manual_seed(instant)
    road = torch.rand(3000, 3, generator=draw, dtype=torch.float64) * torch.tensor([40.0, 12.0, 0.05]) - torch.tensor(
        [0.0, 6.0, 0.0]
    )
    found = [road @ WORLD[:3, :3].T + WORLD[:3, 3]]
    for one in TRACKS:
        on = torch.rand(300, 3, generator=draw, dtype=torch.float64) - 0.5
        axis = torch.randint(0, 3, (300,), generator=draw)
        rows = torch.arange(300)
        on[rows, axis] = torch.where(axis == 2, 0.5, on[rows, axis].sign() * 0.5)
        pose = one.world_from_object[place]
        found.append((0.97 * on * one.size) @ pose[:3, :3].T + pose[:3, 3])
    return torch.cat(found).float()


def sweeps() -> Sweeps:
    made = []
    for place, instant in enumerate(INSTANTS):
        here = points(instant, place)
        colored = torch.zeros(len(here), dtype=torch.bool)
        made.append(Sweep(instant, 0.1 * instant / LAST, here, torch.full_like(here, 0.5), colored, 0.1 * instant))
    return Sweeps.of(tuple(made))


def log(**changes) -> DrivingLog:
    offset = torch.eye(4, dtype=torch.float64)
    offset[:3, 3] = ORIGIN
    path = VehiclePath(torch.stack([vehicle(0.1 * instant) for instant in INSTANTS]))
    sound = DrivingLog("crooked", as_frames(frames()), sweeps(), TRACKS, 11, 2, offset, vehicle=path)
    return replace(sound, **changes)


def said_of(log: DrivingLog) -> tuple[str, ...]:
    return tuple(contradictions(log, log.frames, ("0", "1")))


def seen(change: Callable[[Frame], Frame]) -> DrivingLog:
    # Without lidar: what it says of wrong poses is not meant here.
    return log(frames=as_frames([change(frame) for frame in frames()]), sweeps=Sweeps.of(()))


def boxes(change: Callable[[Track], Track], *names: str) -> DrivingLog:
    return log(tracks=tuple(change(one) if not names or one.name in names else one for one in TRACKS))


def looked(frame: Frame, **changes) -> Frame:
    return replace(frame, camera=replace(frame.camera, **changes))


def shifted(frame: Frame, position: Tensor) -> Frame:
    pose = frame.camera.camera_from_world.double().clone()
    pose[:3, 3] = -pose[:3, :3] @ position
    return looked(frame, camera_from_world=pose.float())


def principal(cx: float, cy: float) -> Callable[[Frame], Frame]:
    return lambda frame: looked(frame, intrinsics=torch.tensor([[50.0, 0, cx], [0, 50.0, cy], [0, 0, 1]]))


def slower(factor: float) -> Callable[[Frame], Frame]:
    return lambda frame: replace(frame, seconds=frame.seconds * factor)


def float32(frame: Frame) -> Frame:
    """The position as float32 stores it in the data set's own world."""
    return shifted(frame, (frame.camera.position.double() + ORIGIN).float().double() - ORIGIN)


def trembling(frame: Frame) -> Frame:
    draw = torch.Generator().manual_seed(100 * frame.indices[0] + frame.indices[1])
    return shifted(frame, frame.camera.position.double() + 0.4 * torch.randn(3, generator=draw, dtype=torch.float64))


def kilometers(frame: Frame) -> Frame:
    return shifted(frame, frame.camera.position.double() / 1000)


def one_pose(frame: Frame) -> Frame:
    return looked(frame, camera_from_world=camera(0.0, 0).camera_from_world)


def placed(change: Tensor) -> Callable[[Track], Track]:
    return lambda one: replace(one, world_from_object=one.world_from_object @ change)


def raised(heights: float) -> Callable[[Track], Track]:
    return lambda one: placed(rigid(0, (0, 0, heights * float(one.size[2]))))(one)


def exchanged(one: Track) -> Track:
    return replace(one, size=one.size[[1, 0, 2]])


def at_place(place: int, change: Tensor) -> Callable[[Track], Track]:
    def changed(one: Track) -> Track:
        poses = one.world_from_object.clone()
        poses[place] = poses[place] @ change
        return replace(one, world_from_object=poses)

    return changed


def first_boxes(one: Track, count: int) -> Track:
    times = None if one.times is None else one.times[:count]
    return replace(one, frames=one.frames[:count], world_from_object=one.world_from_object[:count], times=times)


def sparse(points_change: Tensor, pose_change: Callable[[Tensor], Tensor] = lambda pose: pose) -> DrivingLog:
    """A wall's points in their colors, and images of it, in the turned world; then points or poses are changed."""
    draw = torch.rand(700, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([14.0, 7.0])
    x, y = draw[:, 0] - 3.5, draw[:, 1] - 3.5
    places = torch.stack((x, y, torch.full_like(x, wall.DEPTH)), 1).double()
    places = places @ WORLD[:3, :3].T + WORLD[:3, 3]
    places = places @ points_change[:3, :3].T + points_change[:3, 3]
    turned = [
        looked(frame, camera_from_world=pose_change(frame.camera.camera_from_world.double() @ inverse(WORLD)).float())
        for frame in wall.frames(lambda instant, camera: torch.ones(3))
    ]
    found = SparsePoints(places.float(), wall.albedo(x, y) / 255)
    return log(frames=as_frames(turned), sparse_points=lambda: found, sweeps=Sweeps.of(()), vehicle=None, tracks=())


def w_last(pose: Tensor) -> Tensor:
    """The rotation that comes of a quaternion written x, y, z, w where w is read first."""
    wrong = pose.clone()
    wrong[:3, :3] = quat.to_matrix(quat.from_matrix(pose[:3, :3]).roll(-1))
    return wrong


STILL = frames()[0].image.float()
RIGHT = {
    "as it is": lambda: log(),
    "without a clock": lambda: seen(lambda frame: replace(frame, seconds=None, stamp=None)),
    "with sparse points": lambda: sparse(rigid(0, (0, 0, 0))),
    "a car that stands": lambda: seen(
        lambda frame: replace(one_pose(frame), image=(frame.image * 0 + 0.8 * STILL).to(torch.uint8))
    ),
    "one frame": lambda: log(frames=as_frames(frames()[:1]), tracks=(), sweeps=Sweeps.of(())),
    "noise of annotations": lambda: boxes(at_place(3, rigid(8.0, (0.3, 0.2, 0.0))), "parked"),
    "who turns round within two seconds": lambda: boxes(
        lambda one: replace(at_place(1, rigid(180, (0, 0, 0)))(one), frames=20 * one.frames, times=None), "bike"
    ),
}
FAULTS = {
    "principal point of other sizes": (
        lambda: seen(principal(80.0, 50.0)),
        "is at 80.0, 50.0 of 80x50 pixels, outside",
    ),
    "principal point below 0": (lambda: seen(principal(-5.0, 27.0)), "is at -5.0, 27.0 of 80x50 pixels, outside"),
    "cx and cy exchanged": (lambda: seen(principal(25.5, 37.0)), "as if cx and cy were exchanged"),
    "us for ns": (lambda: seen(slower(1e-3)), "moves by 8,007 m/s and takes 9,000 images a second"),
    "ns for us": (lambda: seen(slower(1e3)), "takes 0.009 images a second: the stamps may be in a finer unit"),
    "millimeters": (
        lambda: seen(lambda frame: shifted(frame, 1000 * frame.camera.position.double())),
        "moves by 8,007 m/s and takes 9 images a second: the stamps may be in us, ms or s where ns are wanted, or",
    ),
    "float32": (lambda: seen(float32), "are multiples of 0.5 m, the grid of float32 at 5,412,"),
    "float32, the vehicle": (
        lambda: log(
            vehicle=VehiclePath(
                torch.stack(
                    [
                        rigid(0, tuple(((vehicle(0.1 * k)[:3, 3] + ORIGIN).float().double() - ORIGIN).tolist()))
                        for k in INSTANTS
                    ]
                )
            )
        ),
        "all positions of the vehicle are multiples of 0.5 m",
    ),
    "trembling": (lambda: seen(trembling), "the poses of camera 0 tremble"),
    "kilometers": (
        lambda: seen(kilometers),
        "of the pixels of camera 0, 1 change over up to 4 images (6 times), while poses stay",
    ),
    "boxes turned": (lambda: boxes(placed(rigid(90, (0, 0, 0)))), "if they were turned by 90 degrees"),
    "sizes exchanged": (
        lambda: boxes(exchanged),
        "if they were turned by 90 degrees, or with length and width exchanged",
    ),
    "sunk": (lambda: boxes(raised(-0.5)), "if they were half a height higher"),
    "raised": (lambda: boxes(raised(0.5)), "if they were half a height lower"),
    "one object turned": (
        lambda: boxes(placed(rigid(90, (0, 0, 0))), "across"),
        "the boxes of object across (car) hold 0.",
    ),
    "boxes beside": (lambda: boxes(placed(rigid(0, (1.5, 1.0, 0)))), "check the poses, sizes and stamps"),
    "a jump": (
        lambda: boxes(at_place(4, rigid(0, (30.0, 0, 0))), "moving"),
        "object moving (car) jumps: at frame 5 its box is 30.0 m beside",
    ),
    "a jump of few boxes": (
        lambda: boxes(lambda one: first_boxes(at_place(4, rigid(0, (30.0, 0, 0)))(one), 8), "moving"),
        "object moving (car) jumps: at frame 5 its box is 30.0 m beside",
    ),
    "a jump of three": (
        lambda: boxes(lambda one: first_boxes(at_place(1, rigid(0, (30.0, 0, 0)))(one), 3), "parked"),
        "object parked (car) moves by 300 m/s",
    ),
    "a box turned": (
        lambda: boxes(at_place(4, rigid(180, (0, 0, 0))), "bike"),
        "object bike (cyclist) turns by 180 degrees from frame 3 to 5",
    ),
    "sparse points elsewhere": (
        lambda: sparse(rigid(0, (500.0, 0, 0))),
        "the log's images see 0% of its 700 own points",
    ),
    "sparse points behind": (
        lambda: sparse(rigid(0, (0, 0, -40.0))),
        "camera 0 sees none of the log's own points in 12 of",
    ),
    "w last": (lambda: sparse(rigid(0, (0, 0, 0)), w_last), "quaternions have w first"),
    "sparse points 4.5 m beside": (
        lambda: sparse(WORLD @ rigid(0, (4.5, 0, 0)) @ inverse(WORLD)),
        "of the pixels that they fall into correlate by",
    ),
}


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_log_has_no_doubts(name: str):
    assert said_of(RIGHT[name]()) == ()


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_doubted_with_its_number(name: str):
    make, words = FAULTS[name]
    said = said_of(make())
    assert any(words in doubt for doubt in said), said


def test_returns_in_a_box_and_its_shell_are_counted_so():
    """60 inside and 40 in the shell, of a box that lies on the road: others are not in it, or the road's."""
    one = track("alone", "car", (4.0, 2.0, 2.0), lambda seconds: rigid(0.0, (20.0, 0.0, 0.0)))
    parts = {
        (1.9, 0.9, 0.9): 60,  # inside
        (2.5, 0.9, 0.9): 20,  # ahead of it, within 0.6 m
        (1.9, -0.9, 1.5): 20,  # above it
        (2.7, 0.9, 0.9): 7,  # farther
        (1.9, 0.9, -0.9): 7,  # 10 cm above its floor
        (2.5, 0.9, -1.2): 7,  # 20 cm below it
    }
    on = torch.cat([torch.tensor(place).expand(count, 3) for place, count in parts.items()]).double()
    pose = one.world_from_object[0]
    here = (on @ pose[:3, :3].T + pose[:3, 3]).float()
    only = Sweep(0, 0.0, here, torch.full_like(here, 0.5), torch.zeros(len(here), dtype=torch.bool), 0.0)
    said = [doubt for doubt in said_of(log(tracks=(one,), sweeps=Sweeps.of((only,)))) if "boxes of car" in doubt]
    assert len(said) == 1
    assert "(alone) hold 0.60 of the returns in and 0.6 m around them" in said[0]


def test_few_objects_are_named_where_many_jump():
    many = tuple(
        replace(at_place(2, rigid(0, (9.0, 0, 0)))(TRACKS[1]), name=f"car {number}", size=TRACKS[1].size)
        for number in range(7)
    )
    said = said_of(log(tracks=many, sweeps=Sweeps.of(())))
    assert len(said) == 4
    assert said[-1].startswith("4 more objects")
