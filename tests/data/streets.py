"""A tiny log in memory."""

import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.types import Camera, Frame, Sweep

INTRINSICS = torch.tensor([[5.0, 0, 2.5], [0, 5.0, 1.5], [0, 0, 1]])


def make_log(num_frames: int = 12, num_cameras: int = 2, sweeps: tuple[Sweep, ...] = ()) -> DrivingLog:
    """Cameras look along world z from (frame, camera, 0); images hold the frame and camera number."""
    frames = []
    for index in range(num_frames):
        for number in range(num_cameras):
            camera_from_world = torch.eye(4)
            camera_from_world[:3, 3] = -torch.tensor([index, number, 0.0])
            image = torch.full((3, 5, 3), (10 * index + number) % 256, dtype=torch.uint8)
            camera = Camera(camera_from_world, INTRINSICS, 5, 3)
            sky = torch.zeros(3, 5, dtype=torch.bool)
            frames.append(Frame(camera, index / max(num_frames - 1, 1), index, number, image=image, sky=sky))
    return DrivingLog(
        "tiny", as_frames(frames), Sweeps.of(sweeps), (), num_frames, num_cameras, torch.eye(4, dtype=torch.float64)
    )
