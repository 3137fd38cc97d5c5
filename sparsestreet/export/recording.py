"""A street as clouds that viewers can play: what stands still, each object in its own frame, and its poses over time.

Viewers of clouds know one color for a Gaussian, no antialias, no lens, no shutter and no mask. A cloud's colors are the
mean of those that the log's cameras see, those that see it nearest counting most (by the area that it fills).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from sparsestreet.export.path import CameraPath, Rig
from sparsestreet.export.ply import check_gaussians, plain_factors
from sparsestreet.finite import check_finite
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import project
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import Placement, RawGaussians
from sparsestreet.ops.spherical_harmonics import view_colors
from sparsestreet.scene.loaded_scene import DAMAGED, check_numbers
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.state import FINISHED
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Gaussians

LOOKS = 12
"""Instants of the log whose cameras color what keeps its shape."""


@dataclass(frozen=True)
class Cloud:
    """Gaussians of one color each, in a frame of their own."""

    centers: Float32[np.ndarray, "n 3"]
    """Meters."""
    covariances: Float32[np.ndarray, "n 3 3"]
    """Square meters."""
    colors: Float32[np.ndarray, "n 3"]
    """In [0, 1]."""
    opacities: Float32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.centers)


@dataclass(frozen=True)
class Part:
    """What moves as one."""

    name: str
    """A node, or a node and one of its objects: ``rigid/car``."""
    shapes: tuple[Cloud, ...]
    """One if it keeps its shape."""
    shown: tuple[int | None, ...]
    """The shape at each instant; None: it is not there."""
    positions: Float32[np.ndarray, "t 3"]
    """Of its frame in the world at each instant, meters."""
    wxyz: Float32[np.ndarray, "t 4"]
    """Unit quaternions."""

    def __len__(self) -> int:
        return sum(len(shape) for shape in self.shapes)


@torch.no_grad()
def recorded_parts(stored: StoredScene, path: CameraPath, every: int) -> list[Part]:
    """Return the parts of a scene at the instants of a path; one that is never there is left out.

    What changes its shape (bodies, networks, masks over time) gets a shape every so many instants, as it is at that
    instant. A field is deformed where the first camera of the instant sees it.

    Raises ValueError for a scene with a number that is NaN, infinite, or becomes so.
    """
    check_numbers(stored.scene)
    nodes, settings = stored.scene.nodes.items(), stored.options.settings
    return [part for name, node in nodes for part in _parts(name, node, path, every, settings)]


def _parts(name: str, node: Node, path: CameraPath, every: int, settings: SplatSettings) -> Iterator[Part]:
    first, instances = _raw(node, path[0]), node.instances()
    # All raw rows of a long drive do not fit in memory.
    places, same = zip(
        *[(raw.placement, _same_shape(raw, first)) for raw in (_raw(node, rig) for rig in path)], strict=True
    )
    if all(same):
        looks = np.unique(np.linspace(0, len(path) - 1, LOOKS).round().astype(int)).tolist()
        wholes = [_whole(name, first, [(_raw(node, path[look]), path[look]) for look in looks], settings)]
    else:
        # A shape is that of an instant in the middle of those that show it.
        keys = [min(start + every // 2, len(path) - 1) for start in range(0, len(path), every)]
        raws = ((_raw(node, path[key]), path[key]) for key in keys)
        wholes = [_whole(name, raw, [(raw, rig)], settings) for raw, rig in raws]
    shape_at = [0 if all(same) else index // every for index in range(len(path))]
    # A slash would make a folder of a viewer's list.
    objects = [name] if instances is None else [f"{name}/{one.replace('/', '_')}" for one in instances.names]
    for number, part_name in enumerate(objects):
        part = _part(part_name, number, places, wholes, shape_at, settings.alpha_min)
        if part.shapes:
            yield part


@dataclass(frozen=True)
class _Whole:
    """A node's Gaussians in the frames of their objects, and their colors."""

    gaussians: Gaussians
    colors: Float[Tensor, "n 3"]


def _whole(name: str, raw: RawGaussians, looks: Sequence[tuple[RawGaussians, Rig]], settings: SplatSettings) -> _Whole:
    own = activate([replace(raw, placement=None)], sh_degree=FINISHED.sh_degree)
    check_gaussians(own, f" of node {name}")
    placed = ((activate([look], sh_degree=0), [view.camera for view in rig]) for look, rig in looks)
    own = replace(own, opacities=own.opacities * plain_factors(placed, settings))
    return _Whole(own, _seen_colors(looks))


def _part(
    name: str,
    number: int,
    places: Sequence[Placement | None],
    wholes: Sequence[_Whole],
    shape_at: Sequence[int],
    smallest: float,
) -> Part:
    rows = slice(None) if places[0] is None else places[0].instances == number
    shapes = [_cloud(whole, rows, smallest) for whole in wholes]
    there = [place is None or bool(place.poses.present[number]) for place in places]
    shown = [shape if seen and len(shapes[shape]) else None for shape, seen in zip(shape_at, there, strict=True)]
    used = sorted({shape for shape in shown if shape is not None})
    positions, wxyz = np.zeros((len(places), 3), np.float32), np.tile(np.eye(4, dtype=np.float32)[0], (len(places), 1))
    for index, place in enumerate(places):
        if place is not None:
            positions[index] = place.poses.translations[number].cpu().numpy()
            wxyz[index] = quat.normalized(place.poses.quaternions[number]).cpu().numpy()
    return Part(
        name,
        tuple(shapes[shape] for shape in used),
        tuple(None if shape is None else used.index(shape) for shape in shown),
        positions,
        wxyz,
    )


def _cloud(whole: _Whole, rows: Tensor | slice, smallest: float) -> Cloud:
    """Return the rows whose opacity is not below what is ever drawn."""
    own = whole.gaussians
    kept = own.opacities[rows] >= smallest
    axes = quat.to_matrix(quat.normalized(own.quaternions[rows][kept])) * own.scales[rows][kept][:, None, :]
    covariances = axes @ axes.mT
    check_finite({"the square of scales": covariances}, DAMAGED)
    numbers = (own.means[rows][kept], covariances, whole.colors[rows][kept], own.opacities[rows][kept])
    centers, covariances, colors, opacities = (value.float().cpu().numpy() for value in numbers)
    return Cloud(centers, covariances, colors, opacities)


def _raw(node: Node, rig: Rig) -> RawGaussians:
    return node.raw_at(rig[0], FINISHED)


def _same_shape(one: RawGaussians, other: RawGaussians) -> bool:
    fields = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")
    if not all(torch.equal(getattr(one, field), getattr(other, field)) for field in fields):
        return False
    if one.multipliers is None or other.multipliers is None:
        return one.multipliers is other.multipliers
    return torch.equal(one.multipliers, other.multipliers)


def _seen_colors(looks: Sequence[tuple[RawGaussians, Rig]]) -> Float[Tensor, "n 3"]:
    """Return the mean color of each row as the cameras see it; that of its first harmonic where none does."""
    first = looks[0][0].sh_dc[:, 0]
    total, weight = torch.zeros_like(first), torch.zeros_like(first[:, :1])
    for raw, rig in looks:
        world = activate([raw], sh_degree=FINISHED.sh_degree)
        sh = world.dense_sh()
        for view in rig:
            _, depths, inside = project(view.camera, world.means)
            near = torch.where(inside & (world.opacities > 0), depths.clamp(min=1).square().reciprocal(), 0.0)[:, None]
            directions = world.means - view.camera.position.to(world.means)
            total = total + near * view_colors(sh, directions, clamped=True)
            weight = weight + near
    plain = view_colors(looks[0][0].sh_dc, torch.ones_like(first), clamped=True)
    return torch.where(weight > 0, total / weight.clamp(min=1e-12), plain)
