"""A flat wall with patches of gray, seen by a car that drives along it: images and returns by formulas alone."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.types import Camera, Frame, Sweep

WIDTH, HEIGHT, FOCAL = 80, 40, 50.0
DEPTH = 10.0
"""Of the wall, meters; it is 16 m of it that an image shows."""
STEP = 0.6
"""Meters that the car drives between two instants."""
INSTANTS = 12
HALF = 0.8
"""Meters from the middle to each of two cameras, which look the same way."""


def camera(instant: int, number: int) -> Camera:
    camera_from_world = torch.eye(4)
    camera_from_world[0, 3] = -(STEP * instant + (2 * number - 1) * HALF)
    intrinsics = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(camera_from_world, intrinsics, WIDTH, HEIGHT)


def albedo(x: Float[Tensor, "*b"], y: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
    """Smooth waves between 60 and 140, in each channel others."""
    waves = [torch.sin(0.7 * x + phase) * torch.cos(0.5 * y - phase) for phase in (0.0, 1.0, 2.0)]
    return 100 + 40 * torch.stack(waves, -1)


def frame(instant: int, number: int, gain: Float[Tensor, "3"]) -> Frame:
    """What a camera sees of the wall, each channel times a gain."""
    seen = camera(instant, number)
    column = torch.arange(WIDTH) + 0.5
    line = torch.arange(HEIGHT) + 0.5
    x = seen.position[0] + DEPTH * (column - WIDTH / 2) / FOCAL
    y = DEPTH * (line - HEIGHT / 2) / FOCAL
    light = albedo(x[None].expand(HEIGHT, WIDTH), y[:, None].expand(HEIGHT, WIDTH))
    image = (gain * light).round().clamp(0, 255).to(torch.uint8)
    return Frame(seen, instant / (INSTANTS - 1), instant, number, image=image)


def frames(gain: Callable[[int, int], Float[Tensor, "3"]]) -> list[Frame]:
    return [frame(instant, number, gain(instant, number)) for instant in range(INSTANTS) for number in (0, 1)]


def sweep(instant: int, points: int = 800) -> Sweep:
    """Random points of the wall around the car."""
    random = torch.rand(points, 2, generator=torch.Generator().manual_seed(instant))
    x = STEP * instant + 16 * (random[:, 0] - 0.5)
    y = 7.8 * (random[:, 1] - 0.5)
    places = torch.stack((x, y, torch.full_like(x, DEPTH)), 1)
    colored = torch.ones(points, dtype=torch.bool)
    return Sweep(instant, instant / (INSTANTS - 1), places, torch.full((points, 3), 0.5), colored)


def sweeps(instants: range = range(INSTANTS)) -> Sweeps:
    return Sweeps.of(tuple(sweep(instant) for instant in instants))


def lazy(made: list[Frame]) -> Frames:
    return as_frames(made)


def random_gains(size: float, seed: int = 0) -> Float[Tensor, "i 2 3"]:
    """Log gains of all images and channels, each on its own; mean zero."""
    made = size * torch.randn(INSTANTS, 2, 3, generator=torch.Generator().manual_seed(seed))
    return made - made.mean((0, 1))
