"""Points with descriptors, and what cameras on a rail see of them."""

from collections.abc import Sequence

import numpy as np
import torch

from sparsestreet.triangulation.matches import Features
from sparsestreet.triangulation.points import Sighting
from sparsestreet.types import Camera, View

FOCAL, WIDTH, HEIGHT = 277.0, 320, 192
INTRINSICS = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def pose(x: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Camera from world of a camera at (x, 0, z); it looks along z at yaw 0, and at 90 degrees along x."""
    angle = np.radians(yaw)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    matrix[:3, 3] = -matrix[:3, :3] @ [x, 0, z]
    return matrix


def view(camera_from_world: np.ndarray, frame_index: int, camera_index: int = 0) -> View:
    camera = Camera(torch.from_numpy(camera_from_world).float(), INTRINSICS, WIDTH, HEIGHT)
    return View(camera, 0.0, frame_index, camera_index)


def imaged(points: np.ndarray, camera_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(normalized image points, pixels, whether in the image)."""
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    rays = local[:, :2] / local[:, 2:]
    pixels = rays * FOCAL + [WIDTH / 2, HEIGHT / 2]
    inside = (local[:, 2] > 0.5) & (pixels >= 0).all(1) & (pixels < [WIDTH, HEIGHT]).all(1)
    return rays, pixels, inside


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unlike each other: random directions in 128 dimensions."""
    values = rng.normal(size=(count, 128))
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def sight(
    points: np.ndarray, described: np.ndarray, camera_from_world: np.ndarray, frame_index: int, shift: float = 0.0
) -> Sighting:
    """What a camera sees of the points, none hidden; ``shift`` moves its features, pixels along x."""
    rays, pixels, inside = imaged(points, camera_from_world)
    along = shift * np.array([1.0, 0.0])
    rays, pixels = rays + along / FOCAL, pixels + along
    colors = np.arange(len(points))[:, None] % 5 / 5 + frame_index / 100 * np.array([0.0, 1.0, 0.0])
    return Sighting(
        view(camera_from_world, frame_index),
        camera_from_world,
        Features(pixels[inside], described[inside]),
        rays[inside],
        colors[inside].astype(np.float32),
    )


def rail(steps: Sequence[float] | np.ndarray) -> list[np.ndarray]:
    """Poses of a camera that is moved sideways."""
    return [pose(x=float(x)) for x in steps]


def cloud(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points ahead of a rail from 0 to 3 m, most of them in all of its images."""
    return rng.uniform((-2, -2, 8), (5, 2, 16), (count, 3))
