"""Minimal valid logs in both flavors, written with NumPy and Pillow alone.

The vehicle drives along world x at 1 m a frame. Camera c looks along x from 1.5 m above the ground and c * 0.5 m to
the left; the lidar sits at 1.8 m and is turned by 90 degrees to the left. One car stands at (10, 2, 0.75).
"""

import json
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 40, 24, 40.0
COLORS = ((200, 30, 30), (30, 30, 200), (30, 200, 30))
FIRST_STAMP, STEP = 1_532_402_927_600_000_251, 100_000_000
"""Nanoseconds since 1970, as nuScenes and Argoverse count; 10 frames a second."""
CAR = np.array([10.0, 2.0, 0.75])
CAR_SIZE = [4.0, 2.0, 1.5]

# Columns: where the camera's x (right), y (down) and z (forward) point in a world with x forward, y left, z up.
WORLD_FROM_OPENCV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TURN_LEFT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
POINTS_IN_WORLD = np.array([[10.0, 0.0, 1.5], [20.0, 0.0, 1.5], [8.0, 0.3, 1.5], [-5.0, 0.0, 1.5], [10.0, 2.0, 0.75]])


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def make_nuscenes(root: Path, *, frames: int = 3, cameras: int = 2, offset: np.ndarray | None = None) -> Path:
    """World coordinates are shifted by ``offset`` (meters), as map coordinates are."""
    offset = np.zeros(3) if offset is None else offset
    for frame in range(frames):
        for camera in range(cameras):
            position = offset + np.array([frame, 0.5 * camera, 1.5])
            write_matrix(root / f"extrinsics/{frame:03d}_{camera}.txt", pose(WORLD_FROM_OPENCV, position))
        lidar = pose(TURN_LEFT, np.array([frame, 0, 1.8]))
        rows = np.zeros((len(POINTS_IN_WORLD), 4))
        rows[:, :3] = (POINTS_IN_WORLD - lidar[:3, 3]) @ lidar[:3, :3]
        write_rows(root / f"lidar/{frame:03d}.bin", rows)
        lidar[:3, 3] += offset
        write_matrix(root / f"lidar_pose/{frame:03d}.txt", lidar)
    write_common(root, frames, cameras, offset)
    return root


def make_waymo(root: Path, *, frames: int = 3, cameras: int = 2, offset: np.ndarray | None = None) -> Path:
    """The same street; the world is turned so that the vehicle, at the ground, drives along world y."""
    offset = np.zeros(3) if offset is None else offset
    for camera in range(cameras):
        # Waymo camera axes are the vehicle's here: x forward, y left, z up.
        write_matrix(root / f"extrinsics/{camera}.txt", pose(np.eye(3), np.array([0, 0.5 * camera, 1.5])))
    for frame in range(frames):
        write_matrix(root / f"ego_pose/{frame:03d}.txt", pose(TURN_LEFT, offset + np.array([0, frame, 0])))
        rows = np.full((len(POINTS_IN_WORLD), 14), -1.0)
        rows[:, :3] = (1.4, 0, 2.2)
        rows[:, 3:6] = POINTS_IN_WORLD - (frame, 0, 0)
        write_rows(root / f"lidar/{frame:03d}.bin", rows)
    write_common(root, frames, cameras, offset)
    return root


def make_mounted_opencv(root: Path, *, columns: int = 4, frames: int = 3, cameras: int = 2) -> Path:
    """DriveStudio's layouts of KITTI, Argoverse (4 columns) and nuPlan (6): Waymo's street, OpenCV's axes."""
    make_waymo(root, frames=frames, cameras=cameras)
    for camera in range(cameras):
        write_matrix(root / f"extrinsics/{camera}.txt", pose(WORLD_FROM_OPENCV, np.array([0, 0.5 * camera, 1.5])))
    for frame in range(frames):
        write_rows(root / f"lidar/{frame:03d}.bin", rows_of(POINTS_IN_WORLD - (frame, 0, 0), columns))
    return root


def make_pandaset(root: Path, *, frames: int = 3, cameras: int = 2) -> Path:
    """As nuScenes, but sweeps have 5 columns, and their poses lie in ego_pose."""
    make_nuscenes(root, frames=frames, cameras=cameras)
    (root / "lidar_pose").rename(root / "ego_pose")
    for path in (root / "lidar").iterdir():
        write_rows(path, rows_of(np.fromfile(path, dtype="<f4").reshape(-1, 4)[:, :3], 5))
    return root


def rows_of(points: np.ndarray, columns: int) -> np.ndarray:
    return np.concatenate([points, np.full((len(points), columns - 3), -1.0)], axis=1)


def write_common(root: Path, frames: int, cameras: int, offset: np.ndarray) -> None:
    for camera in range(cameras):
        write_lines(root / f"intrinsics/{camera}.txt", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0, 0])
        for frame in range(frames):
            name = f"{frame:03d}_{camera}"
            write_image(root / f"images/{name}.jpg", np.full((HEIGHT, WIDTH, 3), COLORS[camera], np.uint8))
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[: HEIGHT // 4] = 255
            write_image(root / f"sky_masks/{name}.png", mask)
            write_image(root / f"dynamic_masks/human/{name}.png", mask[:, ::-1])
            write_image(root / f"dynamic_masks/vehicle/{name}.png", mask[::-1])
    annotations = {
        "frame_idx": list(range(frames)),
        "obj_to_world": [pose(np.eye(3), CAR + offset).tolist()] * frames,
        "box_size": [CAR_SIZE] * frames,
    }
    info = {"0": {"id": "a1", "class_name": "Vehicle", "frame_annotations": annotations}}
    write_json(root / "instances/instances_info.json", info)
    write_json(root / "instances/frame_instances.json", {str(frame): [0] for frame in range(frames)})
    write_stamps(root, [FIRST_STAMP + frame * STEP for frame in range(frames)])


def write_stamps(root: Path, stamps: list[int], name: str = "timestamps.txt") -> None:
    """Nanoseconds as decimal seconds; no float in between rounds them."""
    lines = [f"{stamp // 10**9}.{stamp % 10**9:09d}\n" for stamp in stamps]
    (root / name).write_text("".join(lines))


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def write_lines(path: Path, numbers: list[float]) -> None:
    write_matrix(path, np.array(numbers))


def write_rows(path: Path, rows: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows.astype("<f4").tofile(path)


def write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
