"""The planned drive in the layout of PandaSet."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sparsestreet.data.pandaset.tables import CAMERA_FROM_LIDAR
from sparsestreet.geometry import quaternions as quat
from tests.data.pandaset.pickles import Era, table, write
from tests.data.plan import PER_SECOND, Plan, PlannedCamera, pose, turned

CAMERAS = {"front_camera": "front", "left_camera": "left"}
UUID, TWIN, PARKED = "car-1", "car-1-of-the-front-lidar", "parked-1"


class PandaPlan(Plan):
    """The front camera is taken at the middle of the sweep; the lidar turns about that camera, behind to behind."""

    @property
    def cameras(self) -> tuple[PlannedCamera, ...]:
        front, left = super().cameras
        return replace(front, delay=0), replace(left, delay=-26_000_000)

    @property
    def vehicle_from_lidar(self) -> np.ndarray:
        return self.cameras[0].vehicle_from_camera @ CAMERA_FROM_LIDAR.numpy()

    @property
    def azimuths(self) -> np.ndarray:
        """Ahead is along -y."""
        return super().azimuths - np.pi / 2

    def world_from_box(self, stamps: np.ndarray | int) -> np.ndarray:
        """The box stands upright: PandaSet has no other angle than the yaw."""
        tilted = super().world_from_box(stamps)
        return pose(turned(np.arctan2(tilted[..., 1, 0], tilted[..., 0, 0])), tilted[..., :3, 3])

    def passing(self, frame: int) -> int:
        """When the beam passes the center of the box: found by halving, because the box moves on meanwhile."""
        low, high = -self.period // 2, self.period // 2
        while high - low > 1:
            middle = (low + high) // 2
            stamp = int(self.stamps[frame]) + middle
            lidar = self.world_from_vehicle(stamp) @ self.vehicle_from_lidar
            center = (np.linalg.inv(lidar) @ self.world_from_box(stamp))[:2, 3]
            # Clockwise from ahead (-y): the fraction of the turn that is left.
            ahead = np.arctan2(center[0], center[1]) - np.pi
            angle = (ahead + np.pi) % (2 * np.pi) - np.pi
            low, high = (middle, high) if middle / self.period < angle / (2 * np.pi) else (low, middle)
        return int(self.stamps[frame]) + low


def write_sequence(root: Path, plan: PandaPlan | None = None, *, era: Era = "old", ending: str = ".pkl.gz") -> Path:
    """The folder of the sequence 001, below ``root``."""
    plan = PandaPlan() if plan is None else plan
    folder = root / "001"
    for name, planned in CAMERAS.items():
        camera = next(one for one in plan.cameras if one.name == planned)
        _write_camera(folder / "camera" / name, plan, camera)
    for frame in range(plan.num_frames):
        write(folder / "lidar" / f"{frame:02d}{ending}", table(sweep(plan, frame), era))
        write(folder / "annotations/cuboids" / f"{frame:02d}{ending}", table(cuboids(plan, frame), era))
    # Another frame than that of the returns, as in the data set: nothing may be read from it.
    (folder / "lidar" / "poses.json").write_text(json.dumps(entries(np.tile(np.eye(4), (plan.num_frames, 1, 1)))))
    (folder / "lidar" / "timestamps.json").write_text(json.dumps(seconds(plan.stamps)))
    return folder


def entries(poses: np.ndarray) -> list[dict[str, Any]]:
    quaternions = quat.from_matrix(torch.from_numpy(poses[:, :3, :3])).numpy()
    return [
        {
            "position": dict(zip("xyz", one[:3, 3].tolist(), strict=True)),
            "heading": dict(zip("wxyz", rotation.tolist(), strict=True)),
        }
        for one, rotation in zip(poses, quaternions, strict=True)
    ]


def seconds(stamps: np.ndarray) -> list[float]:
    """Microseconds are exact in a double of today's seconds."""
    return [stamp / PER_SECOND for stamp in stamps.tolist()]


def _write_camera(folder: Path, plan: PandaPlan, camera: PlannedCamera) -> None:
    folder.mkdir(parents=True)
    frames = range(plan.num_frames)
    for frame in frames:
        Image.fromarray(plan.image(frame, camera)).save(folder / f"{frame:02d}.jpg", quality=95)
    poses = np.stack([plan.world_from_camera(frame, camera) for frame in frames])
    stamps = np.array([plan.image_stamp(frame, camera) for frame in frames])
    k = camera.intrinsics
    numbers = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    for name, value in (("intrinsics", numbers), ("poses", entries(poses)), ("timestamps", seconds(stamps))):
        (folder / f"{name}.json").write_text(json.dumps(value))


def sweep(plan: PandaPlan, frame: int) -> dict[str, np.ndarray]:
    """Returns of the spinning lidar, one of the other, and one of the recording car."""
    points, (_, stamps) = plan.world_points(frame), plan.sweep(frame)
    lidar = plan.world_from_vehicle(plan.stamps[frame]) @ plan.vehicle_from_lidar
    ahead, own = (lidar @ np.array([[0.5, -30, 1, 1], [0.9, 1.5, -1.5, 1]]).T).T[:, :3]
    points = np.concatenate((points, [ahead, own]))
    times = np.append(stamps, [plan.stamps[frame]] * 2) / PER_SECOND
    device = np.zeros(len(points), np.int64)
    device[-2] = 1
    columns = {axis: points[:, place].copy() for place, axis in enumerate("xyz")}
    return columns | {"i": np.full(len(points), 7.0), "t": times, "d": device}


def cuboids(plan: PandaPlan, frame: int) -> dict[str, Any]:
    """The planned box where the beam met it, its twin of the other lidar, and a parked car."""
    car, twin = plan.world_from_box(plan.passing(frame)), plan.world_from_box(int(plan.stamps[frame]))
    parked = pose(turned(0.4), np.add(plan.origin, (20, 8, 0.5)))
    poses = np.stack((twin, car, parked))
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - np.pi / 2
    length, width, height = plan.box_size
    return {
        "uuid": [TWIN, UUID, PARKED],
        "label": ["Car", "Car", "Pickup Truck"],
        "yaw": yaw,
        "stationary": np.array([False, False, True]),
        "camera_used": np.array([0, 0, -1]),
        **{f"position.{axis}": poses[:, place, 3].copy() for place, axis in enumerate("xyz")},
        "dimensions.x": np.full(3, width),
        "dimensions.y": np.full(3, length),
        "dimensions.z": np.full(3, height),
        "attributes.object_motion": ["Moving", "Moving", "Parked"],
        "cuboids.sibling_id": [UUID, TWIN, None],
        "cuboids.sensor_id": np.array([1, 0, -1]),
        "attributes.rider_status": [None, np.nan, ""],
    }
