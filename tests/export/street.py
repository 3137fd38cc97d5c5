"""A street of two nodes, small enough to render in milliseconds, and the views of a log that never was."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.effects import Sky, SkySettings
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.nodes.background import Background, BackgroundSettings
from sparsestreet.scene.nodes.tracked import Rigid, RigidSettings
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.scene.storage import StoredScene, save_scene
from sparsestreet.scene.views import write_views
from sparsestreet.types import Camera, View

NUM_FRAMES = 5
"""Time 0, 0.25, 0.5, 0.75, 1."""
YAWS = {0: 0.0, 1: 50.0, 2: -50.0, 3: 170.0}
"""Camera of the rig -> degrees to the left of the direction of travel."""
CAR_ROWS, TRAM_ROWS, ROAD_ROWS = 4, 3, 30

_COMMON = {"min_gaussians": 0, "max_gaussians": None, "mask": None, "masked": False, "density": None}
_COMMON |= {"prunable": False, "learning_rates": {"means": LearningRate(0.1)}}


def stored_street() -> StoredScene:
    """A road, a car that drives all the time, a tram that is there up to time 0.5, a sky of many colors."""
    road = Background(BackgroundSettings(**_COMMON, num_points=0, sources={}), _rows(ROAD_ROWS, 0, degree=2))
    instances = torch.tensor([0] * CAR_ROWS + [1] * TRAM_ROWS)
    objects = Rigid(
        RigidSettings(**_COMMON),
        _rows(len(instances), 1, degree=1, instances=instances),
        Trajectories(
            torch.tensor([[0.0, 1.0], [0.0, 0.5]]),
            torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(2, 2, 1),
            torch.tensor([[[8.0, 1.0, 1.0], [12.0, -1.0, 1.0]], [[9.0, 3.0, 1.0], [9.0, -3.0, 1.0]]]),
            torch.ones(2, 2, dtype=torch.bool),
            torch.tensor([[0.0, 1.0], [0.0, 0.5]]),
        ),
        torch.ones(2, 3),
        names=("car", "tram"),
        max_gap=1.0,
    )
    sky = Sky(SkySettings(resolution=4))
    with torch.no_grad():
        sky.texels.uniform_(0, 1, generator=torch.Generator().manual_seed(2))
    return StoredScene(
        SceneGraph({"background": road, "rigid": objects}, {"sky": sky}), RenderOptions(), "hand-made", NUM_FRAMES
    )


def street_views(width: int = 48, height: int = 32, cameras: tuple[int, ...] = tuple(YAWS)) -> list[View]:
    """The rig drives 1 m a frame along +x and turns 3 degrees a frame; held-out frames are for the test to choose."""
    return [
        View(rig_camera(frame, YAWS[index], width, height), frame / (NUM_FRAMES - 1), frame, index)
        for frame in range(NUM_FRAMES)
        for index in cameras
    ]


def write_street(folder: Path, views: Sequence[View] | None = None, frame_rate: float | None = None) -> Path:
    """Write what a training leaves, a scene and its views, of which those of frame 2 are held out."""
    save_scene(folder / "scene.safetensors", stored_street())
    views = street_views() if views is None else views
    others, held_out = ([view for view in views if (view.frame_index == 2) == held] for held in (False, True))
    write_views(folder / "views.json", others, held_out, frame_rate=frame_rate)
    return folder


def rig_camera(frame: int, yaw: float, width: int, height: int) -> Camera:
    """1.5 m above the ground of a world with z up, with 90 degrees of horizontal view; yaw in degrees to the left."""
    angle = math.radians(yaw + 3.0 * frame)
    forward = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    right = torch.tensor([math.sin(angle), -math.cos(angle), 0.0])
    world_from_camera = torch.eye(4)
    world_from_camera[:3, :3] = torch.stack((right, torch.tensor([0.0, 0.0, -1.0]), forward), dim=1)
    world_from_camera[:3, 3] = torch.tensor([float(frame), 0.1 * frame, 1.5])
    focal = width / 2
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(inverse(world_from_camera), intrinsics, width, height)


def _rows(count: int, seed: int, degree: int, instances: Tensor | None = None) -> Rows:
    """Different values in every entry; those of the road spread along the drive."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    spread = torch.tensor([4.0, 4.0, 1.0]) if instances is None else torch.tensor([0.4, 0.4, 0.4])
    center = torch.tensor([8.0, 0.0, 1.0]) if instances is None else torch.zeros(3)
    parameters = {
        "means": center + spread * normal(count, 3),
        "log_scales": normal(count, 3) * 0.3 - 1.0,
        "quaternions": normal(count, 4),
        "opacity_logits": normal(count) + 1,
        "sh_dc": normal(count, 1, 3),
        "sh_rest": normal(count, (degree + 1) ** 2 - 1, 3) * 0.3,
    }
    return Rows(parameters, {} if instances is None else {"instances": instances})
