"""Poses and intrinsics from text files."""

from itertools import chain
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.clock import LogClock, read_stamps
from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.numbers import read_numbers
from sparsestreet.data.poses import AHEAD_FROM_OPENCV, check_rigid
from sparsestreet.data.problems import fault


def read_pose(path: Path) -> Float64[Tensor, "4 4"]:
    """A rigid transform; raises LogError where the file holds anything else."""
    pose = torch.from_numpy(read_numbers(path))
    if pose.shape != (4, 4):
        raise fault(path, f"a pose is a 4x4 matrix, this is {tuple(pose.shape)}", "write four rows of four numbers")
    check_rigid(pose, path, "the matrix")
    return pose


def read_intrinsics(path: Path) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, "5"]]:
    """The camera matrix in pixels of the full image and the distortion k1, k2, p1, p2, k3; raises LogError."""
    numbers = torch.from_numpy(read_numbers(path)).flatten()
    if numbers.shape != (9,):
        message = f"a camera has 9 numbers (fx fy cx cy k1 k2 p1 p2 k3), this file has {numbers.shape[0]}"
        raise fault(path, message, "write them one a line; zeros for a camera without distortion")
    if not torch.isfinite(numbers).all() or not (numbers[:4] > 0).all():
        message = f"fx, fy, cx, cy must be positive pixels, they are {numbers[:4].tolist()}"
        raise fault(path, message, "write the calibration of the full-size images")
    fx, fy, cx, cy = numbers[:4].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64), numbers[4:]


def world_from_camera(layout: Layout, frame: int, camera: int) -> Float64[Tensor, "4 4"]:
    """Pose of a camera (OpenCV axes) in the data set's world; raises LogError."""
    pose = read_pose(layout.extrinsics(frame, camera))
    if layout.flavor.mounted:
        pose = read_pose(layout.sweep_pose(frame)) @ pose
    return pose if layout.flavor.opencv else pose @ AHEAD_FROM_OPENCV


def first_pose(layout: Layout) -> Float64[Tensor, "4 4"]:
    """Pose of the vehicle, if cameras are mounted on it, else of the front camera, in the data set's world.

    It is that of the first frame read. The log is re-centered on its position; the axes are kept.
    """
    first = layout.frames[0]
    return read_pose(layout.sweep_pose(first) if layout.flavor.mounted else layout.extrinsics(first, layout.front))


def read_vehicle(layout: Layout) -> Float64[Tensor, "f 4 4"]:
    """Poses of the vehicle that cameras are mounted on, one a frame of the window, in the data set's world."""
    return torch.stack([read_pose(layout.sweep_pose(frame)) for frame in layout.frames])


def read_clock(layout: Layout) -> LogClock:
    """The times of the frames of the window; raises LogError for stamps that cannot be those of the folder's frames."""
    stamps = _in_window(layout, layout.timestamps) if layout.has_clock else None
    return LogClock(len(layout.frames), stamps, tuple(chain.from_iterable(read_image_stamps(layout).values())))


def read_image_stamps(layout: Layout) -> dict[int, tuple[int, ...]]:
    """Camera number -> stamps of its images in the window, where they are not those of their frames.

    Raises LogError for stamps that cannot be those of the camera's images, and where images have no poses of their own.
    """
    paths = {camera: layout.image_timestamps(camera) for camera in layout.cameras}
    own = {camera: path for camera, path in paths.items() if path.exists()}
    for path in own.values():
        if not layout.has_clock:
            raise fault(path, "there is no timestamps.txt of the frames beside it", "write it, by the same clock")
        if layout.flavor.mounted:
            message = f"images have instants, but no poses of their own (flavor {layout.flavor.name})"
            raise fault(path, message, "write extrinsics/TTT_C.txt, a pose for each image, as the nuScenes flavor has")
    return {camera: _in_window(layout, path) for camera, path in own.items()}


def _in_window(layout: Layout, path: Path) -> tuple[int, ...]:
    stamps = read_stamps(path, layout.num_frames_on_disk)
    return tuple(stamps[frame] for frame in layout.frames)
