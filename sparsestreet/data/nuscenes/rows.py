"""Rows of nuScenes' tables for a log: made from its views, sweeps and tracks."""

import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import median_low
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.nuscenes.categories import category
from sparsestreet.data.nuscenes.scene import LIDAR
from sparsestreet.data.nuscenes.sweeps import OWN_CAR
from sparsestreet.data.pinhole_frames import rig_of
from sparsestreet.data.placed import PlacedLog, quaternion
from sparsestreet.data.vehicle import Vehicle, vehicle_of
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Sweep, Track, View

Rows = list[dict[str, Any]]
MICROSECOND = 1000
MAP = "maps/empty.png"
CAMERA_PLACE = (1.7, 0.0, 1.5)
"""Of the first camera on the car: about that of nuScenes' front camera, as logs do not say where their car is."""
VEHICLE_FROM_LIDAR = torch.tensor([[0.0, 1, 0, 1.7], [-1, 0, 0, 0], [0, 0, 1, 1.8], [0, 0, 0, 1]], dtype=torch.float64)
"""nuScenes' axes (x right, y ahead, z up), 0.3 m above the first camera: logs do not say where their lidar is."""


@dataclass(frozen=True)
class Returns:
    """What the rows say of sweeps, each of which is read once."""

    stamps: dict[int, int]
    """Frame -> nanoseconds of its sweep."""
    counts: dict[tuple[str, int], int]
    """(object, frame) -> returns in its box."""
    near: int
    """Returns so near to the lidar that readers take them for the recording car's."""
    total: int


@dataclass(frozen=True)
class SceneRows:
    """The tables of a log as one scene whose instants are all keyframes."""

    placed: PlacedLog
    channels: dict[int, str]
    """Index of a camera -> its channel."""
    ending: str
    """Of images."""

    @cached_property
    def name(self) -> str:
        """Of the scene, and in paths."""
        return re.sub(r"[^\w.-]", "_", self.placed.log.name) or "log"

    def image_path(self, view: View) -> str:
        return self._path(self.channels[view.indices[1]], view.indices[0], self.ending)

    def sweep_path(self, frame: int) -> str:
        return self._path(LIDAR, frame, "pcd.bin")

    def sweep_points(self, sweep: Sweep) -> Float64[Tensor, "n 3"]:
        """In the frame of the lidar at the sweep's stamp."""
        stamp = self.placed.sweep_stamp(sweep)
        return transform_points(inverse(self._vehicle.at(stamp) @ VEHICLE_FROM_LIDAR), self.placed.points(sweep))

    @cached_property
    def frames(self) -> list[int]:
        """Those with an image: samples."""
        return sorted({view.indices[0] for view in self.placed.log.views})

    @cached_property
    def returns(self) -> Returns:
        stamps, counts, near, total = {}, {}, 0, 0
        for sweep in self.placed.log.sweeps.gray():
            stamps[sweep.index] = self.placed.sweep_stamp(sweep)
            near += int((self.sweep_points(sweep).norm(dim=1) < OWN_CAR).sum())
            total += len(sweep.points)
            for track in self.placed.log.tracks:
                counts[track.name, sweep.index] = self.placed.returns_in(track, sweep)
        return Returns(stamps, counts, near, total)

    @cached_property
    def sample_stamps(self) -> dict[int, int]:
        """Frame -> the stamp of its boxes, or of its sweep, or of its first image."""
        boxes: dict[int, list[int]] = {}
        for track in self.placed.log.tracks:
            for frame, stamp in self.placed.box_stamps(track).items():
                boxes.setdefault(frame, []).append(stamp)
        first = {view.indices[0]: self.placed.view_stamp(view) for view in reversed(self.placed.log.views)}
        others = first | self.returns.stamps | {frame: median_low(stamps) for frame, stamps in boxes.items()}
        return {frame: others[frame] for frame in self.frames}

    def tables(self) -> dict[str, Rows]:
        tables = self._scene() | self._sensors() | self._objects()
        tables["sample_data"], tables["ego_pose"] = [], []
        for channel in self._channel_names():
            files = list(self._files(channel))
            for row, links in zip(files, _links([row["token"] for row in files]), strict=True):
                pose = row.pop("pose")
                tables["sample_data"].append(row | links)
                tables["ego_pose"].append({"token": row["token"], "timestamp": row["timestamp"]} | _placed(pose))
        return tables

    def _channel_names(self) -> list[str]:
        return [*self.channels.values(), *([LIDAR] if len(self.placed.log.sweeps) else [])]

    def _scene(self) -> dict[str, Rows]:
        samples = [_token("sample", frame) for frame in self.frames]
        scene = {"token": _token("scene"), "log_token": _token("log"), "name": self.name, "description": ""}
        ends = {"first_sample_token": samples[0], "last_sample_token": samples[-1], "nbr_samples": len(samples)}
        log = {"token": _token("log"), "logfile": "", "vehicle": "", "date_captured": "", "location": ""}
        drawn = {"token": _token("map"), "log_tokens": [log["token"]], "category": "semantic_prior", "filename": MAP}
        return {
            "scene": [scene | ends],
            "log": [log],
            "map": [drawn],
            "sample": [
                {"token": token, "timestamp": _micros(self.sample_stamps[frame]), "scene_token": scene["token"]} | links
                for token, frame, links in zip(samples, self.frames, _links(samples), strict=True)
            ],
        }

    def _sensors(self) -> dict[str, Rows]:
        rig = rig_of(self.placed.log)
        matrices = {channel: rig[index].intrinsics.double() for index, channel in self.channels.items()}
        sensors, calibrations = [], []
        for channel in self._channel_names():
            modality = "camera" if channel in matrices else "lidar"
            sensors.append({"token": _token("sensor", channel), "channel": channel, "modality": modality})
            matrix = []
            if channel in matrices:
                # nuScenes counts from the center of the first pixel.
                matrix = (matrices[channel] - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])).tolist()
            row = {"token": _token("mount", channel), "sensor_token": sensors[-1]["token"], "camera_intrinsic": matrix}
            calibrations.append(row | _placed(self._mount(channel)))
        return {"sensor": sensors, "calibrated_sensor": calibrations}

    @cached_property
    def _vehicle(self) -> Vehicle:
        return vehicle_of(self.placed.log, self.placed.times, CAMERA_PLACE)

    def _mount(self, channel: str) -> Float64[Tensor, "4 4"]:
        """vehicle_from_sensor."""
        if channel == LIDAR:
            return VEHICLE_FROM_LIDAR
        return next(self._vehicle.mounts[index] for index, name in self.channels.items() if name == channel)

    def _files(self, channel: str) -> Iterator[dict[str, Any]]:
        """Rows of sample_data, with the ``pose`` of the car at each."""
        if channel == LIDAR:
            for frame in self.frames:
                if frame in self.returns.stamps:
                    stamp = self.returns.stamps[frame]
                    row = self._file(channel, frame, stamp, self.sweep_path(frame), "pcd", (0, 0))
                    yield row | {"pose": self._vehicle.at(stamp)}
            return
        camera_from_vehicle = inverse(self._mount(channel))
        for view in self.placed.log.views:
            if self.channels[view.indices[1]] == channel:
                size, stamp = (view.camera.width, view.camera.height), self.placed.view_stamp(view)
                row = self._file(channel, view.indices[0], stamp, self.image_path(view), self.ending, size)
                yield row | {"pose": self.placed.world_from_camera(view) @ camera_from_vehicle}

    def _file(
        self, channel: str, frame: int, stamp: int, path: str, kind: str, size: tuple[int, int]
    ) -> dict[str, Any]:
        token = _token("file", channel, frame)
        return {
            "token": token, "sample_token": _token("sample", frame), "ego_pose_token": token,
            "calibrated_sensor_token": _token("mount", channel), "timestamp": _micros(stamp), "fileformat": kind,
            "is_key_frame": True, "height": size[1], "width": size[0], "filename": path,
        }  # fmt: skip

    def _objects(self) -> dict[str, Rows]:
        boxes = {track.name: self._boxes(track) for track in self.placed.log.tracks}
        tracks = [track for track in self.placed.log.tracks if boxes[track.name]]
        names = {track.name: category(track.class_name) for track in tracks}
        return {
            "category": [
                {"token": _token("category", name), "name": name, "description": ""}
                for name in sorted(set(names.values()))
            ],
            "attribute": [],
            "visibility": [],
            "instance": [
                {
                    "token": instance_token(track.name), "category_token": _token("category", names[track.name]),
                    "nbr_annotations": len(boxes[track.name]),
                    "first_annotation_token": boxes[track.name][0]["token"],
                    "last_annotation_token": boxes[track.name][-1]["token"],
                }
                for track in tracks
            ],
            "sample_annotation": [row for track in tracks for row in boxes[track.name]],
        }  # fmt: skip

    def _boxes(self, track: Track) -> Rows:
        frames = [frame for frame in track.frames.tolist() if frame in self.sample_stamps]
        tokens = [_token("box", track.name, frame) for frame in frames]
        length, width, height = track.size.tolist()
        rows = []
        for frame, token, links in zip(frames, tokens, _links(tokens), strict=True):
            pose = self.placed.box(track, frame, self.sample_stamps[frame])
            rows.append(
                {
                    "token": token, "sample_token": _token("sample", frame),
                    "instance_token": instance_token(track.name), "visibility_token": "", "attribute_tokens": [],
                    "size": [width, length, height], "num_lidar_pts": self.returns.counts.get((track.name, frame), 0),
                    "num_radar_pts": 0,
                }
                | _placed(pose)
                | links
            )  # fmt: skip
        return rows

    def _path(self, channel: str, frame: int, ending: str) -> str:
        return f"samples/{channel}/{self.name}__{channel}__{frame:06d}.{ending}"


def instance_token(name: str) -> str:
    """The object's own name where it can be a token, because readers call objects so."""
    return name if re.fullmatch(r"[\w.:-]+", name, re.ASCII) else _token("instance", name)


def _token(*parts: object) -> str:
    return hashlib.md5(repr(parts).encode(), usedforsecurity=False).hexdigest()


def _micros(stamp: int) -> int:
    return (stamp + MICROSECOND // 2) // MICROSECOND


def _placed(pose: Float64[Tensor, "4 4"]) -> dict[str, Any]:
    return {"translation": pose[:3, 3].tolist(), "rotation": quaternion(pose)}


def _links(tokens: Sequence[str]) -> Iterator[dict[str, str]]:
    for before, after in zip(["", *tokens[:-1]], [*tokens[1:], ""], strict=True):
        yield {"prev": before, "next": after}
