"""Writes the common drive as COLMAP does: a sparse model in text or binary, and images in a folder a camera."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sparsestreet.geometry import quaternions as quat
from tests.data.plan import Plan

UNIT = 4.0
"""Meters to a unit of the model."""
MODEL_IDS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9,
}  # fmt: skip


@dataclass
class Tables:
    """What a model's files say."""

    cameras: dict[int, tuple[str, int, int, list[float]]]
    """Number -> model, width, height, numbers."""
    images: dict[int, tuple[list[float], int, str]]
    """Number -> quaternion and translation, camera, name."""
    points: list[tuple[list[float], list[int], int]]
    """Position, color, and how many observations it has."""


def tables(plan: Plan, lenses: Mapping[str, tuple[str, Sequence[float]]] | None = None) -> Tables:
    """``lenses``: camera -> model and numbers; None: pinholes."""
    cameras, images = {}, {}
    for number, camera in enumerate(plan.cameras, start=3):
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        model, numbers = ("PINHOLE", [fx, fy, cx, cy]) if lenses is None else lenses[camera.name]
        cameras[number] = (model, camera.width, camera.height, list(numbers))
        for frame in reversed(range(plan.num_frames)):  # numbers of images tell nothing of their order
            pose = np.linalg.inv(plan.world_from_camera(frame, camera))
            rotation = quat.from_matrix(torch.from_numpy(pose[:3, :3])).tolist()
            row = [*rotation, *(pose[:3, 3] / UNIT).tolist()]
            images[len(images) + 5] = (row, number, f"{camera.name}/{frame + 8}.png")
    positions = plan.world_points(0) / UNIT
    colors = np.random.default_rng(7).integers(0, 256, positions.shape)
    points = [(*pair, index % 4) for index, pair in enumerate(zip(positions.tolist(), colors.tolist(), strict=True))]
    return Tables(cameras, images, points)


def write_images(folder: Path, plan: Plan) -> None:
    for camera in plan.cameras:
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
        for frame in range(plan.num_frames):
            Image.fromarray(plan.image(frame, camera)).save(folder / camera.name / f"{frame + 8}.png")


def write_text(folder: Path, tables: Tables) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [" ".join(map(str, (number, *row[:3], *row[3]))) for number, row in tables.cameras.items()]
    (folder / "cameras.txt").write_text("# Camera list\n" + "\n".join(cameras) + "\n")
    images = []
    for place, (number, (pose, camera, name)) in enumerate(tables.images.items()):
        images += [" ".join(map(str, (number, *pose, camera, name))), "" if place % 2 else "1.5 2.5 -1 3.5 4.5 7"]
    (folder / "images.txt").write_text("# Image list\n# Number of images\n" + "\n".join(images) + "\n")
    points = [
        " ".join(map(str, (index, *position, *color, 0.5, *([5, 0] * length))))
        for index, (position, color, length) in enumerate(tables.points)
    ]
    (folder / "points3D.txt").write_text("# Points\n" + "\n".join(points) + "\n")


def write_binary(folder: Path, tables: Tables) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    cameras = struct.pack("<Q", len(tables.cameras))
    for number, (model, width, height, numbers) in tables.cameras.items():
        cameras += struct.pack(f"<iiQQ{len(numbers)}d", number, MODEL_IDS[model], width, height, *numbers)
    images = struct.pack("<Q", len(tables.images))
    for place, (number, (pose, camera, name)) in enumerate(tables.images.items()):
        images += struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0"
        images += struct.pack("<Q", place % 3) + struct.pack("<ddq", 1.5, 2.5, -1) * (place % 3)
    points = struct.pack("<Q", len(tables.points))
    for index, (position, color, length) in enumerate(tables.points):
        points += struct.pack("<Q3d3BdQ", index, *position, *color, 0.5, length) + struct.pack("<ii", 5, 0) * length
    for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(content)


def write_colmap(folder: Path, plan: Plan, *, binary: bool = True) -> Tables:
    """Returns what was written, in the folders that COLMAP's users have."""
    content = tables(plan)
    write_images(folder / "images", plan)
    (write_binary if binary else write_text)(folder / "sparse" / "0", content)
    return content
