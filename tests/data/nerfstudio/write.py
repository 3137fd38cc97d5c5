"""Writes the common drive as nerfstudio does: ``transforms.json``, images, sparse points."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from tests.data.plan import Plan

UNIT = 4.0
"""Meters to a unit of the file."""
OPENGL = np.diag([1.0, -1, -1, 1])


def points_of(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Where the sparse points lie, and their colors in counts."""
    positions = plan.world_points(0)
    return positions, np.random.default_rng(7).integers(0, 256, positions.shape).astype(np.uint8)


def transforms(plan: Plan, folder: Path) -> dict[str, Any]:
    """The JSON's content, in the layout of several cameras: each frame has its intrinsics. Images are written."""
    frames = []
    for camera in plan.cameras:
        (folder / "images" / camera.name).mkdir(parents=True, exist_ok=True)
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        for frame in range(plan.num_frames):
            name = f"images/{camera.name}/frame_{frame + 8}.png"  # 10 comes behind 9
            Image.fromarray(plan.image(frame, camera)).save(folder / name)
            pose = plan.world_from_camera(frame, camera) @ OPENGL
            pose[:3, 3] /= UNIT
            frames.append(
                {"file_path": f"./{name}", "transform_matrix": pose.tolist(), "camera_model": "OPENCV"}
                | {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": camera.width, "h": camera.height}
            )
    return {"applied_transform": np.eye(4)[:3].tolist(), "ply_file_path": "sparse_pc.ply", "frames": frames}


def write_nerfstudio(folder: Path, plan: Plan, text: bool = True) -> dict[str, Any]:
    """Returns the JSON's content."""
    content = transforms(plan, folder)
    positions, colors = points_of(plan)
    names = [(axis, "f8") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.empty(len(positions), dtype=names)
    for index, axis in enumerate("xyz"):
        rows[axis] = positions[:, index] / UNIT
    for index, color in enumerate(("red", "green", "blue")):
        rows[color] = colors[:, index]
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(folder / "sparse_pc.ply")
    write_json(folder, content)
    return content


def write_json(folder: Path, content: Any) -> None:
    (folder / "transforms.json").write_text(json.dumps(content))
