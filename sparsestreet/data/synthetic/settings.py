"""Settings of a synthetic street; equal settings give the same bytes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch

from sparsestreet.geometry.lenses import fold_radius_squared, undistort
from sparsestreet.types import Side


@dataclass(frozen=True, kw_only=True)
class LidarSensor:
    """A lidar that turns about the vertical axis. Raises ValueError for values that no sensor has."""

    name: str
    elevations: Sequence[float]
    """(lowest, highest) beam, degrees above the horizon; the other beams are evenly spread between them."""
    beams: int
    azimuth_steps: int
    """Number of rays of one beam in a full turn; three cameras of 60 degrees see about 40 percent of them."""
    max_range: float
    """Meters; farther surfaces give no return."""
    noise: float
    """Standard deviation of the measured range, meters."""
    dropout: float
    """Probability that a return is lost, independently of the others, in [0, 1)."""
    height: float
    """Height above the ground on the ego car, meters."""

    def __post_init__(self) -> None:
        for name in ("beams", "azimuth_steps", "max_range", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"LidarSensor.{name} must be positive but is {getattr(self, name)}")
        if not self.noise >= 0:
            raise ValueError(f"LidarSensor.noise must not be negative but is {self.noise}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"LidarSensor.dropout must lie in [0, 1) but is {self.dropout}")
        # A list from a config file becomes a tuple, so that equal sensors compare equal.
        object.__setattr__(self, "elevations", tuple(float(elevation) for elevation in self.elevations))
        ends = (-90.0, *self.elevations, 90.0)
        if len(ends) != 4 or not ends[0] < ends[1] <= ends[2] < ends[3]:
            raise ValueError(
                "LidarSensor.elevations must be the lowest and the highest beam's degrees within (-90, 90) but is "
                f"{list(self.elevations)}"
            )


WAYMO_TOP = LidarSensor(
    name="waymo_top",
    elevations=(-17.6, 2.4),
    beams=64,
    azimuth_steps=662,
    max_range=75.0,
    noise=0.02,
    dropout=0.05,
    height=1.9,
)
"""The default sensor; conf/data/lidar/waymo_top.yaml names the source of the numbers."""


CAMERA_YAWS_DEGREES = (0.0, 50.0, -50.0)
"""Front, front left, front right. With 60 degrees of view each, neighbors overlap by 10."""


TURNS = 2 * math.pi / 4
"""Radians a second, of the weaving of a car that turns."""
_LANE = 1.75
"""Meters from the middle of the lane to its border."""


def swing(speed: float, turn: float) -> float:
    """Meters to each side of the lane's middle: y = swing sin(TURNS t) has the slope tan(turn) at t = 0."""
    return speed * math.tan(math.radians(turn)) / TURNS


@dataclass(frozen=True)
class StreetSettings:
    """A short drive along a straight street, seen by up to three cameras and a spinning lidar.

    >>> StreetSettings(num_frames=21, frame_rate=10.0).duration
    2.0
    """

    seed: int = 0
    """Decides houses, colors, traffic, weather and everything else but the sensors."""
    num_frames: int = 40
    width: int = 320
    """Image width, pixels."""
    height: int = 192
    """Image height, pixels."""
    num_cameras: int = 3
    """1: front; 2: also front left; 3: also front right."""
    field_of_view: float = 60.0
    """Horizontal field of view of every camera, degrees; a lens changes it and keeps the focal length."""
    lens: Sequence[float | int] = ()
    """Brown-Conrady k1, k2, p1, p2, k3 of every camera, in OpenCV's order; empty: pinholes."""
    delays: Sequence[float | int] = ()
    """Seconds from the stamp of a frame to the image of each camera, less than a frame; negative: before. The lidar and
    the boxes have the stamp of the frame. Empty: all cameras fire at it."""
    delays_known: bool = True
    """False: the street's files say of every image that it was taken at the pose and the stamp of its frame. It is the
    control of readers that heed the instants of cameras."""
    exposure_walk: float = 0.0
    """Standard deviation over the drive of each camera's exposure, EV, which walks smoothly around 0. One EV doubles
    what an image stores."""
    white_balance: float = 0.0
    """Relative standard deviation, over cameras and channels, of the constant gains of each camera's channels. They
    change no camera's brightness, and cancel over the cameras."""
    readout: float = 0.0
    """Seconds from the first row or column of an image to the last: a rolling shutter. An image's stamp and pose are
    those of the middle. 0: all pixels at once."""
    readout_direction: Side = "top"
    """The side of every image that is read first."""
    readout_known: bool = True
    """False: the street's files are silent on the readout."""
    shutter_time: float = 0.0
    """Seconds of exposure: light is averaged over them, so what moves is blurred. 0: images are sharp."""
    shutter_time_known: bool = True
    """False: the street's files are silent on it."""
    hood: float = 0.0
    """Share of an image that the hood of the recording car covers, at its bottom: dark, with the sky mirrored in it."""
    hood_cameras: Literal["front", "all"] = "front"
    """Whose images it covers."""
    hood_known: bool = False
    """True: the street's files have masks of it."""
    dirt: float = 0.0
    """Share of the front camera's images that three dark, soft spots on its lens cover."""
    night: float = 0.0
    """Stops by which there is less light, EV; the noise of the sensor shows then."""
    jpeg: int = 97
    """Quality of the images' files, 1 to 100, without halved colors."""
    supersampling: int = 2
    """Rays per pixel and axis; a pixel's color is the mean of supersampling^2 rays."""
    frame_rate: float = 10.0
    """Frames per second."""
    ego_speed: float = 8.0
    """Mean speed of the recording car, meters per second."""
    turn: float = 0.0
    """Degrees by which the recording car turns to the left and to the right of the street, once in 4 seconds. It weaves
    within its lane, and its heading changes by up to 1.6 times as many degrees a second."""
    num_parked_cars: int = 14
    num_moving_cars: int = 5
    """Oncoming and overtaking in turn; their meetings with the ego car are spread over the drive."""
    num_pedestrians: int = 6
    num_crossing: int = 0
    """People who cross the street 6 to 10 m before the car, spread over the drive. They walk through other traffic:
    leave out moving cars."""
    num_cyclists: int = 2
    limp: float = 0.0
    """Share by which a pedestrian's right leg and arm swing less than the left ones; 1: not at all."""
    tunnel: bool = False
    """Whether the street runs through a tunnel, with lamps, tiles and doors instead of houses: no sky is seen."""
    body_pose_noise: float = 3.0
    """Error of a pedestrian's body pose in each frame: root mean square over the joints, degrees."""
    pose_noise: Sequence[float | int] = ()
    """Meters and degrees, root mean square: each image's pose in the files is off by a random rigid motion of its own.
    Empty: poses are exact."""
    box_noise: Sequence[float | int] = ()
    """Meters, and degrees of heading, root mean square: each box of a frame is off by a random motion of its own.
    Empty: boxes are exact."""
    lidar: LidarSensor = WAYMO_TOP
    annotation_range: float = 60.0
    """Objects farther from the ego car than this are not annotated, meters."""

    def __post_init__(self) -> None:
        positive = (
            "num_frames", "width", "height", "supersampling", "frame_rate", "ego_speed", "annotation_range",
        )  # fmt: skip
        for name in positive:
            if not getattr(self, name) > 0:
                raise ValueError(f"StreetSettings.{name} must be positive but is {getattr(self, name)}")
        not_negative = (
            "seed", "num_parked_cars", "num_moving_cars", "num_pedestrians", "num_crossing", "num_cyclists",
            "body_pose_noise", "exposure_walk", "white_balance", "readout", "shutter_time", "hood", "dirt", "night",
            "turn",
        )  # fmt: skip
        for name in not_negative:
            if getattr(self, name) < 0:
                raise ValueError(f"StreetSettings.{name} must not be negative but is {getattr(self, name)}")
        limits = {
            "num_cameras": (1, len(CAMERA_YAWS_DEGREES), "be 1, 2 or 3"),
            "limp": (0, 1, "be a share from 0 to 1"),
            "jpeg": (1, 100, "be a quality from 1 to 100"),
            "hood": (0, 0.5, "be a share of the image up to 0.5"),
            "dirt": (0, 0.1, "be a share of the image up to 0.1"),
            "field_of_view": (10, 120, "lie in [10, 120] degrees"),
        }
        for name, (low, high, words) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"StreetSettings.{name} must {words} but is {getattr(self, name)}")
        for name in ("readout", "shutter_time"):
            if getattr(self, name) * self.frame_rate >= 1:
                frame = f"a frame of {1 / self.frame_rate:g} s"
                raise ValueError(f"StreetSettings.{name} must be shorter than {frame} but is {getattr(self, name)}")
        if self.readout_direction not in get_args(Side):
            sides = ", ".join(get_args(Side))
            raise ValueError(f"StreetSettings.readout_direction must be one of {sides} but is {self.readout_direction}")
        if self.hood_cameras not in ("front", "all"):
            raise ValueError(f"StreetSettings.hood_cameras must be front or all but is {self.hood_cameras}")
        if self.white_balance and self.num_cameras == 1:
            raise ValueError(
                "StreetSettings.white_balance needs two cameras: the constant gains of one are colors of the street"
            )
        if swing(self.ego_speed, self.turn) > _LANE:
            raise ValueError(
                f"StreetSettings.turn must keep the car within {_LANE:g} m of its lane's middle, but {self.turn:g} "
                f"degrees at {self.ego_speed:g} m/s take it {swing(self.ego_speed, self.turn):.2f} m off: turn less"
            )
        # Equal values compare equal, whatever type of sequence or number they were given as.
        object.__setattr__(self, "delays", tuple(float(value) for value in self.delays))
        if self.delays and (
            len(self.delays) != self.num_cameras or not all(abs(one) * self.frame_rate < 1 for one in self.delays)
        ):
            raise ValueError(
                f"StreetSettings.delays must be empty or one for each of {self.num_cameras} cameras, shorter than a "
                f"frame of {1 / self.frame_rate:g} s, but is {list(self.delays)}"
            )
        for name in ("pose_noise", "box_noise"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
            noise = getattr(self, name)
            if noise and not (len(noise) == 2 and all(0 <= value < math.inf for value in noise)):
                raise ValueError(f"StreetSettings.{name} must be empty or [meters, degrees] but is {list(noise)}")
        object.__setattr__(self, "lens", tuple(float(value) for value in self.lens))
        if self.lens and not (len(self.lens) == 5 and self._sees_every_pixel()):
            raise ValueError(
                "StreetSettings.lens must be empty or five coefficients k1, k2, p1, p2, k3 whose polynomial can be "
                f"undone in the whole image but is {list(self.lens)}: choose smaller ones or a smaller field_of_view"
            )

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.num_frames - 1) / self.frame_rate

    @property
    def recorded(self) -> tuple[float, float]:
        """Seconds, from time 0 of the street, of the first and the last stamp of its files."""
        delays = self.delays if self.delays_known else ()
        return min((0.0, *delays)), self.duration + max((0.0, *delays))

    def image_time(self, frame: int, camera: int) -> float:
        """Seconds at which a camera takes its image of a frame."""
        return frame / self.frame_rate + (self.delays[camera] if self.delays else 0.0)

    def _sees_every_pixel(self) -> bool:
        """Whether every place in the image has a ray that the polynomial describes, before its fold."""
        coefficients = torch.tensor(self.lens, dtype=torch.float64)
        side = torch.linspace(-1, 1, 17, dtype=torch.float64) * math.tan(math.radians(self.field_of_view) / 2)
        try:
            rays = undistort(torch.cartesian_prod(side, side * self.height / self.width), coefficients)
        except ValueError:
            return False
        return bool((rays.square().sum(-1) <= fold_radius_squared(coefficients)).all())
