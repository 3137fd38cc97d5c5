"""Small hand-made scenes, rows, cameras and logs; nothing touches the disk."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.trajectories import Trajectories
from sparsestreet.scene.build import assign_tracks
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.sources import FarPoints, ImagePoints, LidarPoints, NearPoints, PointSource, Seeds
from sparsestreet.scene.initialize.training_data import Coverage, TrainingData
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.scene.masks import Mask, StaticMask, StaticMaskSettings
from sparsestreet.scene.nodes import Background, BackgroundSettings, NodeSettings, Rigid, RigidSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.triangulation import StreetPoints, TriangulatedPoints
from sparsestreet.types import Camera, Frame, Sweep, Track, View

RATES = {
    name: LearningRate(0.01)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "mask_logits")
}
"""Every column that a node's table may have."""

POSE_RATES = {"rotation_deltas": LearningRate(0.001), "translation_deltas": LearningRate(0.001)}


@dataclass(frozen=True, kw_only=True)
class Asked(PointSource):
    """A source that is asked for a fixed part of the points, whatever the images show."""

    source: PointSource
    part: float

    def share(self, coverage: Coverage) -> float:
        return self.part

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        return self.source.draw(count, data, generator)


SOURCES = {"lidar": LidarPoints(), "images": ImagePoints(), "near": NearPoints(part=0.5), "far": FarPoints(part=0.5)}
"""All there are, half of the guesses near and half far."""


def background_settings(
    lidar: int = 0,
    images: int = 0,
    near: int = 0,
    far: int = 0,
    *,
    kind: type[BackgroundSettings] = BackgroundSettings,
    **changes,
) -> BackgroundSettings:
    """So many points of each source; no limits, no mask, no density control, unless said."""
    asked = {"lidar": lidar, "images": images, "near": near, "far": far}
    total = sum(asked.values())
    sources = {name: Asked(source=SOURCES[name], part=count / total) for name, count in asked.items() if count}
    said = {"num_points": total, "sources": sources, "learning_rates": RATES, "prunable": True}
    return kind(**(_UNLIMITED | said | changes))


def rigid_settings(**changes) -> RigidSettings:
    """The cars of ``street_log`` that move; no limits, no mask, no density control, unless said."""
    said = {"classes": ("Car",), "min_path_length": 1.0, "learning_rates": RATES | POSE_RATES, "prunable": False}
    plain = {"min_displacement": None, "min_instance_gaussians": 0.0, "points_per_instance": 5000}
    return RigidSettings(**(_UNLIMITED | plain | said | changes))


_UNLIMITED = {"min_gaussians": 0, "max_gaussians": None, "mask": None, "masked": False, "density": None}


def static_mask(min_gaussians: int = 0, *, sparsity_weight: float = 1.0, **changes) -> StaticMask:
    return StaticMaskSettings(sparsity_weight, **changes).build(min_gaussians)


def background(rows: Rows, mask: Mask | None = None, **changes) -> Background:
    return Background(background_settings(**changes), rows, mask)


def rigid(
    rows: Rows,
    keyframes: Trajectories,
    sizes: Tensor | None = None,
    *,
    mask: Mask | None = None,
    names: list[str] | None = None,
    max_gap: float = 0.05,
    **changes,
) -> Rigid:
    """Boxes of 1 m, unless said."""
    sizes = torch.ones_like(keyframes.translations[:, 0]) if sizes is None else sizes
    return Rigid(rigid_settings(**changes), rows, keyframes, sizes, mask=mask, names=names, max_gap=max_gap)


def view_at(time: float, camera: Camera | None = None) -> View:
    """A view of no recorded frame."""
    return View(camera_at(0.0) if camera is None else camera, time)


def degree(sh_degree: int) -> SceneState:
    """A finished scene of which only some harmonics are in use."""
    return SceneState(sh_degree=sh_degree)


def training_data(
    log: DrivingLog | None = None,
    held_out: frozenset[int] = frozenset(),
    movers: NodeSettings | None = None,
    points: StreetPoints | None = None,
) -> TrainingData:
    """What a node sees of a log; ``movers`` says which of its tracks move (none, if nobody says)."""
    log = street_log() if log is None else log
    taken = () if movers is None else assign_tracks(log.tracks, {"movers": movers}).claimed
    frames = log.frames.where(lambda view: view.frame_index not in held_out)
    return TrainingData(log, frames, held_out, tracks=taken, moving=taken, image_points=points)


def triangulated(
    positions: list[list[float]],
    seen: Sequence[tuple[int, int, float, float]] = (),
    *,
    color: tuple[float, float, float] = (0.5, 0.5, 0.5),
    pixel_size: float = 0.01,
) -> TriangulatedPoints:
    """Points of one color; ``seen``: (point, place of the view, column, row) of each observation."""
    count = len(positions)
    rows = np.array(seen, np.float32).reshape(-1, 4)
    return TriangulatedPoints(
        np.array(positions, np.float32).reshape(count, 3),
        np.full((count, 3), color, np.float32),
        np.full(count, pixel_size, np.float32),
        rows[:, 0].astype(np.int64),
        rows[:, 1].astype(np.int64),
        rows[:, 2:],
    )


def random_rows(
    count: int,
    seed: int,
    *,
    sh_degree: int = 1,
    mask: Mask | None = None,
    instances: Tensor | None = None,
    dtype: torch.dtype = torch.float32,
) -> Rows:
    """Rows with different values in every entry, a few meters around the origin; the mask's columns at their start."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    parameters = {
        "means": normal(count, 3),
        "log_scales": normal(count, 3) * 0.3 - 1.5,
        "quaternions": normal(count, 4),
        "opacity_logits": normal(count),
        "sh_dc": normal(count, 1, 3),
        "sh_rest": normal(count, (sh_degree + 1) ** 2 - 1, 3) * 0.3,
    }
    learned = {} if mask is None else mask.initial_columns(count)
    return Rows(parameters | learned, {} if instances is None else {"instances": instances}, transient=learned.keys())


def pose(yaw: float, translation: tuple[float, float, float]) -> Float[Tensor, "4 4"]:
    """World-from-box: a turn about z (radians), then a shift (meters); float64."""
    matrix = torch.eye(4, dtype=torch.float64)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    matrix[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    matrix[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return matrix


def track(
    name: str,
    frames: list[int],
    poses: list[Tensor],
    size: tuple[float, float, float] = (4.0, 2.0, 1.5),
    class_name: str = "Car",
) -> Track:
    return Track(name, class_name, torch.tensor(frames), torch.stack(poses), torch.tensor(size))


def keyframes(
    tracks: list[Track], num_frames: int, held_out: frozenset[int] = frozenset(), dtype: torch.dtype = torch.float32
) -> Trajectories:
    made = Trajectories.from_tracks(tracks, held_out, num_frames)
    return Trajectories(
        made.times.to(dtype),
        made.quaternions.to(dtype),
        made.translations.to(dtype),
        made.valid,
        made.spans.to(dtype),
    )


def camera_at(x: float, width: int = 33, height: int = 21) -> Camera:
    """At (x, 0, 1.5) m in a world with z up, looking along +x with 90 degrees of horizontal view."""
    world_from_camera = torch.tensor(
        [[0.0, 0.0, 1.0, x], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
    )
    focal = width / 2
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(inverse(world_from_camera), intrinsics, width, height)


CAR_COLOR = (0.9, 0.1, 0.2)
ROAD_COLOR = (0.3, 0.4, 0.5)
NUM_FRAMES = 5


def car_pose(frame: int) -> Float[Tensor, "4 4"]:
    """A car that drives 2 m a frame and turns 0.1 rad a frame."""
    return pose(0.1 * frame, (8.0 + 2.0 * frame, 1.0, 0.75))


def frame_at(index: int) -> Frame:
    """The left half of every image is green, the right half blue; the top five rows are sky."""
    camera = camera_at(0.5 * index)
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    image[:, : camera.width // 2, 1] = 255
    image[:, camera.width // 2 :, 2] = 255
    sky = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    sky[:5] = True
    return Frame(camera, index / (NUM_FRAMES - 1), index, 0, image=image, sky=sky)


def sweep_at(index: int, car_points: int) -> Sweep:
    """Points on the road ahead and inside the moving car, in their colors; the last point has no color."""
    generator = torch.Generator().manual_seed(index)
    road = torch.rand(50, 3, generator=generator) * torch.tensor([25.0, 8.0, 0.0]) + torch.tensor([3.0, -10.0, 0.0])
    in_box = (torch.rand(car_points, 3, generator=generator) - 0.5) * torch.tensor([3.9, 1.9, 1.4])
    car = (in_box.double() @ car_pose(index)[:3, :3].T + car_pose(index)[:3, 3]).float()
    points = torch.cat((road, car, torch.tensor([[-5.0, 0.0, 0.0]])))
    colors = torch.tensor([ROAD_COLOR] * 50 + [CAR_COLOR] * car_points + [(0.5, 0.5, 0.5)])
    colored = torch.ones(points.shape[0], dtype=torch.bool)
    colored[-1] = False
    return Sweep(index, index / (NUM_FRAMES - 1), points, colors, colored)


def street_log(car_points: int = 60) -> DrivingLog:
    """Five frames of one camera: a car that drives away, one that is parked, a cyclist."""
    frames = list(range(NUM_FRAMES))
    tracks = (
        track("parked", frames, [pose(0.0, (10.0, -5.0, 0.7))] * NUM_FRAMES),
        track("driving", frames, [car_pose(frame) for frame in frames]),
        track("bicycle", [1, 2], [pose(0.0, (6.0, -2.0, 0.8)), pose(0.0, (9.0, -2.0, 0.8))], class_name="Cyclist"),
    )
    return DrivingLog(
        name="hand-made",
        frames=as_frames([frame_at(index) for index in frames]),
        sweeps=Sweeps.of(tuple(sweep_at(index, car_points) for index in frames)),
        tracks=tracks,
        num_frames=NUM_FRAMES,
        num_cameras=1,
        dataset_from_world=torch.eye(4, dtype=torch.float64),
    )
