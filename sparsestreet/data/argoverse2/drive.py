"""The tables of a log in the layout of Argoverse 2: where the vehicle was, its cameras, sweeps and boxes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.argoverse2.layout import EGO_ROWS, SPIN, nearest_images
from sparsestreet.data.argoverse2.tables import NEAR_DUPLICATE, QUATERNION, SIZE, TRANSLATION
from sparsestreet.data.directions import ego_losses, names_by_direction
from sparsestreet.data.encoded import mask_png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes, stamps_of_frames
from sparsestreet.data.motion import PosePath
from sparsestreet.data.pinhole_frames import MASKS, PinholeFrames, rig_of
from sparsestreet.data.placed import PlacedLog
from sparsestreet.data.roles import role_of
from sparsestreet.data.vehicle import Vehicle, vehicle_of
from sparsestreet.data.writer import LogFile
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import inside_box
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Sweep, View

CAMERAS = {
    "ring_front_center": 0.0, "ring_front_left": 45.0, "ring_front_right": -45.0, "ring_side_left": 99.0,
    "ring_side_right": -99.0, "ring_rear_left": 153.0, "ring_rear_right": -153.0,
}  # fmt: skip
"""Degrees to the left of the first, about as the cameras stand."""
CATEGORIES = frozenset(
    (
        "ANIMAL", "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOLLARD", "BOX_TRUCK", "BUS", "CONSTRUCTION_BARREL",
        "CONSTRUCTION_CONE", "DOG", "LARGE_VEHICLE", "MESSAGE_BOARD_TRAILER", "MOBILE_PEDESTRIAN_CROSSING_SIGN",
        "MOTORCYCLE", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "RAILED_VEHICLE", "REGULAR_VEHICLE",
        "SCHOOL_BUS", "SIGN", "STOP_SIGN", "STROLLER", "TRAFFIC_LIGHT_TRAILER", "TRUCK", "TRUCK_CAB",
        "VEHICULAR_TRAILER", "WHEELCHAIR", "WHEELED_DEVICE", "WHEELED_RIDER",
    )
)  # fmt: skip
_OF_ROLES = {"vehicle": "REGULAR_VEHICLE", "cyclist": "BICYCLIST", "pedestrian": "PEDESTRIAN"}
_CAMERA, _LIDAR = (1.6, 0.0, 1.65), (0.9, 0.0, 1.9)
"""Where the first camera and the lidar are put: meters ahead, left and up, as on the embedded street."""
_EARLIEST = 1_000_000_000
"""Nanoseconds: names of files are positive stamps."""
_HALF = SPIN // 2
_STEP = 100_000_000
"""Nanoseconds between two poses, at most; the layout's own lie closer."""


def category(class_name: str) -> str:
    """Argoverse's name of a class of any data set; what is no road user that is known keeps its name.

    >>> category("Vehicle"), category("STROLLER"), category("Misc")
    ('REGULAR_VEHICLE', 'STROLLER', 'Misc')
    """
    return class_name if class_name in CATEGORIES else _OF_ROLES.get(role_of(class_name), class_name)


@dataclass(frozen=True)
class Drive:
    """The tables of a log."""

    log: DrivingLog
    half: bool
    times: LogTimes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", LogTimes.of(self.log, _EARLIEST))

    @property
    def name(self) -> str:
        return self.log.name.replace("/", "_") or "log"

    @cached_property
    def placed(self) -> PlacedLog:
        return PlacedLog(self.log, self.times)

    @cached_property
    def names(self) -> dict[int, str]:
        return names_by_direction(self.placed, CAMERAS, "camera_")

    @cached_property
    def vehicle(self) -> Vehicle:
        return vehicle_of(self.log, self.times, _CAMERA)

    @cached_property
    def stamps(self) -> tuple[int, ...]:
        """Of the sweeps. Readers take the images nearest to 50 ms later: where those of a log's own stamps would be
        others, half a turn before the middle of the frame's images."""
        own = stamps_of_frames(self.log, self.times)
        views: dict[int, list[int]] = {}
        for view in self.log.views:
            views.setdefault(view.indices[0], []).append(self.times.of_view(view))
        middles = tuple(
            (min(views[frame]) + max(views[frame])) // 2 - _HALF if frame in views else stamp
            for frame, stamp in enumerate(own)
        )
        return min((own, middles), key=self._unfound)

    @cached_property
    def path(self) -> PosePath:
        """The vehicle's, at all images, whose poses it gives exactly, and between them where that takes long."""
        rows: dict[int, Float64[Tensor, "4 4"]] = {}
        for view in sorted(self.log.views, key=lambda view: view.indices[1]):
            mount = self.vehicle.mounts[view.indices[1]]
            rows.setdefault(self.times.of_view(view), self.placed.world_from_camera(view) @ inverse(mount))
        stamps = sorted(rows)
        kept = [stamp for place, stamp in enumerate(stamps) if not place or stamp - stamps[place - 1] > NEAR_DUPLICATE]
        return PosePath(torch.tensor(kept), torch.stack([rows[stamp] for stamp in kept]), 2**62)

    def poses(self) -> dict[str, Any]:
        seen = self.path.stamps.tolist()
        wanted = sorted({*seen, *self.stamps})
        between = [
            before + step * (behind - before) // -(-(behind - before) // _STEP)
            for before, behind in pairwise(wanted)
            for step in range(1, -(-(behind - before) // _STEP))
        ]
        stamps = torch.tensor(sorted((*wanted, *between)))
        return {"timestamp_ns": stamps.numpy()} | _transforms(self.path.at(stamps))

    def intrinsics(self) -> dict[str, Any]:
        """Pixels of the data set have their centers at whole numbers. The images are without their lens."""
        rig = rig_of(self.log)
        k = np.stack([rig[index].intrinsics.double().numpy() for index in self.names])
        return {
            "sensor_name": list(self.names.values()),
            "fx_px": k[:, 0, 0],
            "fy_px": k[:, 1, 1],
            "cx_px": k[:, 0, 2] - 0.5,
            "cy_px": k[:, 1, 2] - 0.5,
            **{name: np.zeros(len(k)) for name in ("k1", "k2", "k3")},
            "height_px": np.array([rig[index].height for index in self.names], np.uint16),
            "width_px": np.array([rig[index].width for index in self.names], np.uint16),
        }

    def mounts(self) -> dict[str, Any]:
        """With two lidars, without which Argoverse's own library opens no sweep; no point depends on them."""
        lidar = torch.eye(4, dtype=torch.float64)
        lidar[:3, 3] = torch.tensor(_LIDAR, dtype=torch.float64)
        poses = torch.stack([*(self.vehicle.mounts[index] for index in self.names), lidar, lidar])
        return {"sensor_name": [*self.names.values(), "up_lidar", "down_lidar"]} | _transforms(poses)

    def sweep(self, frame: int) -> dict[str, Any]:
        """Intensities, lasers and offsets are 0: a log has none."""
        points = self.points(frame).numpy()
        columns = {axis: points[:, place] for place, axis in enumerate("xyz")}
        columns = {axis: column.astype(np.float16 if self.half else np.float32) for axis, column in columns.items()}
        kinds = {"intensity": np.uint8, "laser_number": np.uint8, "offset_ns": np.int32}
        return columns | {name: np.zeros(len(points), kind) for name, kind in kinds.items()}

    def points(self, frame: int) -> Float64[Tensor, "n 3"]:
        """In the vehicle's frame at the stamp of the sweep, those in boxes where the boxes then are."""
        if frame not in self.log.sweeps.indices:
            return torch.zeros(0, 3, dtype=torch.float64)
        sweep: Sweep = self.log.sweeps.load_gray(frame)
        ego_from_world = inverse(self.path.at(torch.tensor([self.stamps[frame]]))[0])
        return transform_points(ego_from_world, self.placed.points(sweep, self.stamps[frame]))

    def boxes(self) -> dict[str, Any]:
        columns: dict[str, list[Any]] = {name: [] for name in ("timestamp_ns", "track_uuid", "category")}
        sizes, poses, counts = [], [], []
        for frame, stamp in enumerate(self.stamps):
            tracks = [track for track in self.log.tracks if (track.frames == frame).any()]
            points, back = self.points(frame), inverse(self.path.at(torch.tensor([stamp]))[0])
            for track in tracks:
                pose = back @ self.placed.box(track, frame, stamp)
                for name, value in zip(columns, (stamp, track.name, category(track.class_name)), strict=True):
                    columns[name].append(value)
                sizes.append(track.size.double())
                poses.append(pose)
                counts.append(int(inside_box(transform_points(inverse(pose), points).float(), track.size).sum()))
        numbers = torch.stack(sizes).numpy()
        named = {name: numbers[:, place] for place, name in enumerate(SIZE)}
        return columns | named | _transforms(torch.stack(poses)) | {"num_interior_pts": np.array(counts)}

    def masks(self, frames: PinholeFrames, view: View, name: str, stem: str) -> Iterator[LogFile]:
        """Of a camera whose lowest rows readers take for the recording car, also that it shows none of it."""
        files = list(frames.mask_files(view.indices, name, stem))
        for file in files:
            yield LogFile(f"{self.name}/{file.path}", file.content)
        own = f"{MASKS}/ego/{name}/{stem}.png"
        if name in EGO_ROWS and own not in {file.path for file in files}:
            none = np.zeros((view.camera.height, view.camera.width), bool)
            yield LogFile(f"{self.name}/{own}", lambda: [mask_png(none)])

    def losses(self) -> Iterator[str]:
        own = stamps_of_frames(self.log, self.times)
        moved = [abs(one - other) for one, other in zip(self.stamps, own, strict=True) if one != other]
        if moved:
            yield (
                f"{len(moved)} sweeps get stamps up to {max(moved) / 1e6:.3g} ms away, for readers to find their "
                "images 50 ms later; boxes and the points in them are carried there"
            )
        if lost := self._unfound(self.stamps):
            yield f"{lost} of {len(self.log.views)} images are passed over by readers: they are not next to their sweep"
        frames = [frame for frame in self.log.sweeps.indices if frame < self.log.num_frames]
        if self.half and frames:
            parts = [self.points(frame).numpy() for frame in frames]
            steps = np.concatenate([np.abs(part - part.astype(np.float16)).max(1) for part in parts])
            if len(steps):
                yield f"points are float16: {len(steps)} of them move by up to {steps.max() * 1e3:.2g} mm an axis"
        off = [self._off(view) for view in self.log.views]
        if max(off) > 1e-4:
            yield f"each camera has one mount: poses of images are off by up to {max(off):.2g} m"
        yield from ego_losses(self.placed, self.names, EGO_ROWS)

    def _off(self, view: View) -> float:
        found = self.path.at(torch.tensor([self.times.of_view(view)]))[0] @ self.vehicle.mounts[view.indices[1]]
        return float((found - self.placed.world_from_camera(view))[:3, 3].norm())

    def _unfound(self, stamps: tuple[int, ...]) -> int:
        """How many images a reader of sweeps at these stamps would not find, or find at another sweep."""
        if any(late <= early for early, late in pairwise(stamps)):
            return len(self.log.views) + 1
        missed = 0
        for index in self.names:
            views = {view.indices[0]: self.times.of_view(view) for view in self.log.views if view.indices[1] == index}
            found = nearest_images(stamps, sorted(views.values()))
            missed += sum(found[frame] != stamp for frame, stamp in views.items())
        return missed


def _transforms(poses: Float64[Tensor, "n 4 4"]) -> dict[str, np.ndarray]:
    turns, places = quat.from_matrix(poses[:, :3, :3]).numpy(), poses[:, :3, 3].numpy()
    named = {name: turns[:, place] for place, name in enumerate(QUATERNION)}
    return named | {name: places[:, place] for place, name in enumerate(TRANSLATION)}
