"""Writes Gaussians as a .ply file in the layout of 3DGS, which the field's viewers and converters read."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.atomic import atomic_file
from sparsestreet.data.lazy import spread
from sparsestreet.finite import check_finite
from sparsestreet.geometry.quaternions import normalized
from sparsestreet.ops import SplatSettings
from sparsestreet.ops.reference import on_screen, visible_rows
from sparsestreet.ops.reference.projection import COMPENSATION_FLOOR
from sparsestreet.scene.graph import SceneGaussians
from sparsestreet.scene.loaded_scene import DAMAGED, check_numbers
from sparsestreet.scene.nodes.node import Instances, Node
from sparsestreet.scene.state import FINISHED
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Camera, Gaussians, View

_ANYWHERE = Camera(torch.eye(4), torch.eye(3), 1, 1)
"""A camera for views without indices, of which nodes use only the time."""

_MAX_OPACITY = 1 - 2.0**-25
"""Halfway between 1 and the largest float32 below 1. Its logit is finite, and the sigmoid of this logit is 1 again."""

_TOLD_APART = 1000
"""Times that are said with three decimals, however many frames a scene file claims."""

ANTIALIASED = "comment SplatRenderMode: mip"
"""In the header: what gsplat and Brush go by. Others add the blur of plain 3DGS."""

_MIN_SCALE = 1e-30
"""Smallest scale that is written, meters; a scale of 0 has no logarithm."""


def write_ply(path: Path | str, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Write the Gaussians whose opacity is above 0 and return their number; write the whole file or nothing.

    Binary, little endian, float32, one vertex a Gaussian: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_* (all of red,
    then green, then blue), opacity (logit), scale_0..2 (log of meters), rot_0..3 (unit, wxyz). ``antialiased`` is said
    in a comment. Raises ValueError for
    values that are not finite or if no Gaussian is left, OSError if the file cannot be written.
    """
    check_gaussians(gaussians)
    table = _vertices(gaussians)
    if not len(table):
        raise ValueError("a ply needs a Gaussian with an opacity above 0, got none: choose more, or another time")
    with atomic_file(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(_header(len(table), gaussians.dense_sh().shape[1], antialiased).encode("ascii"))
        file.write(table.tobytes())
    return len(table)


def check_gaussians(gaussians: Gaussians, of: str = "", rows: slice = slice(None)) -> None:
    """Raise ValueError where a number is NaN or infinite, also of a row that is not seen; names field, row and value.

    Every writer asks before it leaves rows out: a comparison of opacities drops those that are NaN. ``of``: what is
    said behind a field's name.
    """
    check_finite({f"{name}{of}": column.detach()[rows] for name, column in gaussians.columns().items()}, DAMAGED)


@torch.no_grad()
def scene_gaussians(
    stored: StoredScene,
    time: float,
    *,
    nodes: Collection[str] | None = None,
    instances: Collection[str] | None = None,
) -> Gaussians:
    """Return all or some of the scene's Gaussians in the world frame at a time in [0, 1].

    Args:
        stored: an opened scene file.
        time: normalized; 0 is the log's first frame, 1 its last.
        nodes: names of the nodes to return (``["background"]``: nothing that moves); None: all.
        instances: names of tracks; only their Gaussians are returned. Not together with ``nodes``.

    Raises ValueError, naming the available ones, for an unknown node or instance, or one absent at that time; and for
    a scene with a number that is NaN, infinite, or becomes so (``log_scales`` of 100).
    """
    if not 0 <= time <= 1:
        raise ValueError(f"time runs from 0 (first frame of the log) to 1 (its last), got {time}")
    if nodes is not None and instances is not None:
        raise ValueError("Gaussians are chosen by nodes or by instances, got both: leave one out")
    check_numbers(stored.scene)
    placed = stored.scene.gaussians_at(View(_ANYWHERE, time))
    placed = replace(placed, gaussians=replace(placed.gaussians, sh=placed.gaussians.dense_sh()))
    for name, rows in placed.spans.items():
        check_gaussians(placed.gaussians, f" of node {name}", rows)
    if instances is not None:
        keep = _rows_of_instances(stored, placed, instances, time)
    else:
        keep = _rows_of_nodes(placed, placed.spans if nodes is None else nodes)
    return Gaussians(**{name: column[keep] for name, column in placed.gaussians.columns().items()})


def instance_names(stored: StoredScene) -> list[str]:
    """Return the names of the tracks whose Gaussians can be exported alone."""
    objects = [node.instances() for node in stored.scene.nodes.values()]
    return [name for some in objects if some is not None for name in some.names]


def _rows_of_nodes(placed: SceneGaussians, names: Collection[str]) -> Bool[Tensor, " n"]:
    _known("node", names, list(placed.spans))
    keep = torch.zeros_like(placed.gaussians.opacities, dtype=torch.bool)
    for name in names:
        keep[placed.spans[name]] = True
    return keep


def _rows_of_instances(
    stored: StoredScene, placed: SceneGaussians, names: Collection[str], time: float
) -> Bool[Tensor, " n"]:
    _known("instance", names, instance_names(stored))
    keep = torch.zeros_like(placed.gaussians.opacities, dtype=torch.bool)
    for node_name, node in stored.scene.nodes.items():
        objects = node.instances()
        if objects is None:
            continue
        for name in sorted(set(names) & set(objects.names)):
            rows = objects.ids == objects.names.index(name)
            if not bool((placed.gaussians.opacities[placed.spans[node_name]][rows] > 0).any()):
                raise ValueError(
                    f"{name} is not in the scene at time {time:g}: {_presence(stored, node, objects, name)}"
                )
            keep[placed.spans[node_name]] |= rows
    return keep


def _presence(stored: StoredScene, node: Node, objects: Instances, name: str) -> str:
    """Say between which times an object's Gaussians have an opacity: of even frames, and of the ends of its span."""
    steps, place = min(max(stored.num_frames - 1, 1), _TOLD_APART), objects.names.index(name)
    rows = objects.ids == place
    ends = [] if objects.spans is None else objects.spans[place].tolist()
    times = {*ends, *(step / steps for step in range(steps + 1))}
    seen = [time for time in sorted(times) if bool((_at(node, time).opacities[rows] > 0).any())]
    return f"it is there from {seen[0]:.3f} to {seen[-1]:.3f}" if seen else "it has no Gaussians"


def _at(node: Node, time: float) -> Gaussians:
    return node.gaussians_at(View(_ANYWHERE, time), FINISHED)


def _known(kind: str, names: Collection[str], known: Collection[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        listed = ", ".join(known) or "none"
        raise ValueError(f"the scene has no {kind} {unknown[0]!r}; it has {listed}")


def _vertices(gaussians: Gaussians) -> Float[np.ndarray, "n p"]:
    """Return one row a vertex, its properties in the order of the header, little endian."""
    keep = gaussians.opacities > 0
    values = {name: column.detach()[keep].cpu() for name, column in gaussians.columns().items()}
    opacities = values["opacities"].double().clamp(max=_MAX_OPACITY)
    columns = (
        values["means"],
        torch.zeros_like(values["means"]),
        values["sh"][:, 0],
        # [term, color] becomes [color, term], because all terms of red come first.
        values["sh"][:, 1:].mT.flatten(1),
        torch.logit(opacities)[:, None],
        values["scales"].double().clamp(min=_MIN_SCALE).log(),
        normalized(values["quaternions"].double()),
    )
    return torch.cat([column.float() for column in columns], dim=1).numpy().astype("<f4")


def _header(rows: int, terms: int, antialiased: bool) -> str:
    properties = ["x", "y", "z", "nx", "ny", "nz"]
    properties += [f"f_dc_{index}" for index in range(3)]
    properties += [f"f_rest_{index}" for index in range(3 * (terms - 1))]
    properties += ["opacity", *(f"scale_{index}" for index in range(3)), *(f"rot_{index}" for index in range(4))]
    comments = [ANTIALIASED] if antialiased else []
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {rows}"]
    lines += [f"property float {name}" for name in properties]
    return "\n".join([*lines, "end_header", ""])


MAX_CAMERAS = 36
"""Cameras of a log that are asked, spread over its time."""


@torch.no_grad()
def plain_factors(looks: Iterable[tuple[Gaussians, Sequence[Camera]]], settings: SplatSettings) -> Float[Tensor, "..."]:
    """Return by what each row's opacity is multiplied for viewers that do not antialias; 1 for a row nobody sees.

    A scene that was trained with antialias has small Gaussians whose opacity falls where the blur of the screen widens
    them (Mip-Splatting, Yu et al. 2024): by sqrt(det / det_blurred), which depends on the camera. Viewers of plain 3DGS
    blur without that factor, and would show far surfaces too thick and too bright. So a file for them holds opacities
    with the mean factor of the cameras that see a Gaussian. What the log's cameras saw is then 2 to 15 dB nearer to
    what training drew (docs/shipping.md).

    Args:
        looks: the same rows where they are at some time, meters in the world, and the cameras of then.
        settings: those that the scene was trained with. Without antialias the one factor of all rows is 1.
    """
    if not settings.antialias:
        return torch.ones(())
    total = count = torch.zeros(())
    for gaussians, cameras in looks:
        for camera in cameras:
            rows = visible_rows(gaussians, camera, settings)
            ratios = on_screen(gaussians, rows, camera, settings).ratios
            assert ratios is not None  # with antialias
            own = torch.zeros_like(gaussians.opacities)
            seen = own.index_fill(0, rows, 1.0)
            own[rows] = ratios.clamp(min=COMPENSATION_FLOOR**2).sqrt()
            total, count = total + own, count + seen
    return torch.where(count > 0, total / count.clamp(min=1), 1.0)


def spread_cameras(views: Sequence[View]) -> list[Camera]:
    """Return cameras of some views, spread over all of them."""
    return [views[place].camera for place in spread(len(views), MAX_CAMERAS)]
