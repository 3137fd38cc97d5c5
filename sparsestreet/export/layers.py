"""What a picture is made of: depth, coverage, and which node or object each pixel shows."""

import colorsys
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8, UInt16
from PIL import Image
from torch import Tensor

from sparsestreet.atomic import atomic_folder
from sparsestreet.data.lazy import Sweeps
from sparsestreet.data.lidar import depth_image
from sparsestreet.export.path import CameraPath
from sparsestreet.export.video import Picture, side_by_side
from sparsestreet.ops import contribution, splat
from sparsestreet.ops.spherical_harmonics import of_colors
from sparsestreet.pictures.images import color_map
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering, node_legend
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import Camera, View

_COLUMN = "images_seen"


@torch.no_grad()
def count_images(stored: StoredScene, views: Iterable[View]) -> None:
    """Give the rows of all nodes a column: the number of views in which a Gaussian shows.

    It shows where it has the largest part of at least one pixel, as in the paper's importance. What another Gaussian
    hides has no such pixel. Objects that are edited, moved or copied later take their counts along.
    """
    counts = {
        name: torch.zeros(len(node.rows), dtype=torch.int64, device=node.rows.means.device)
        for name, node in stored.scene.nodes.items()
    }
    for view in views:
        placed = stored.scene.gaussians_at(view)
        options = stored.options
        counted = contribution(placed.gaussians, placed.view.camera, settings=options.settings, backend=options.backend)
        for name, rows in placed.spans.items():
            counts[name] += counted.dominant[rows] > 0
    for name, node in stored.scene.nodes.items():
        node.rows.register_buffer(_COLUMN, counts[name], persistent=False)


def images_seen(scene: SceneGraph, spans: Mapping[str, slice]) -> Float[Tensor, " n"]:
    """Return the counts in the order of a rendering's rows; 0 for what the recorded images never had.

    Raises ValueError where no node has counts.
    """
    columns = {name: scene.nodes[name].rows.columns() for name in spans}
    if not any(_COLUMN in found for found in columns.values()):
        raise ValueError("nobody has counted the recorded images of this scene: call count_images before it is edited")
    return torch.cat([found.get(_COLUMN, torch.zeros_like(found["means"][:, 0])).float() for found in columns.values()])


MAX_MILLIMETERS = 65_535
"""Millimeters of a depth that is no smaller; 0 where there is none."""


class LidarReturns:
    """The sweeps of a log, each at its time."""

    def __init__(self, sweeps: Sweeps, times: Mapping[int, float]) -> None:
        """``times``: frame of each sweep -> normalized time."""
        self.times = times
        self._load = sweeps.load_gray
        self._read: tuple[int, Float[Tensor, "n 3"]] | None = None

    def points(self, time: float) -> Float[Tensor, "n 3"]:
        """Return of the sweep that is nearest in time, in the world; cameras of an instant share one reading."""
        frame = min(self.times, key=lambda frame: abs(self.times[frame] - time))
        if self._read is None or self._read[0] != frame:
            self._read = frame, self._load(frame).points
        return self._read[1]

    def millimeters(self, camera: Camera, time: float) -> UInt16[np.ndarray, "h w"]:
        """Depth along the optical axis of the nearest return in each pixel; 0: none; see ``MAX_MILLIMETERS``.

        The lens is followed, a rolling shutter is not: all returns are where the sweep has them.
        """
        depth = depth_image(self.points(time), camera)
        millimeters = (1000 * depth).round().clamp(max=MAX_MILLIMETERS)
        return millimeters.numpy().astype(np.uint16)


def enlarged(values: UInt16[np.ndarray, "h w"], side: int) -> UInt16[np.ndarray, "h w"]:
    """Each value as a square of so many pixels, to the right and down; the nearer one where two of them meet."""
    found = np.where(values > 0, values.astype(np.int64), MAX_MILLIMETERS + 1)
    padded = np.pad(found, ((side - 1, 0), (side - 1, 0)), constant_values=MAX_MILLIMETERS + 1)
    height, width = found.shape
    found = np.min([padded[y : y + height, x : x + width] for y in range(side) for x in range(side)], axis=0)
    return np.where(found > MAX_MILLIMETERS, 0, found).astype(np.uint16)


Values = Shaped[np.ndarray, "_h _w *_c"]
"""rgb uint8 [h, w, 3]; depth and lidar uint16, millimeters; alpha uint8; ids of nodes uint8, of instances uint16;
seen uint8, images."""

_SOLID = 0.5
"""Of alpha, from which a pixel has a depth."""
_DOTS = 320
"""Dots of the lidar that fit side by side into a picture, at most."""
_NEAR, _FAR = 1.0, 100.0
"""Meters of the lightest and of the darkest color in a picture of depth."""
_ENOUGH_IMAGES = 32
"""Images that have seen enough: the lightest color in a picture of ``seen``."""
_MAX_IMAGES = 255


@torch.no_grad()
def layer_values(
    stored: StoredScene, view: View, layers: Sequence[str], returns: LidarReturns | None = None
) -> dict[str, Values]:
    """Return the layers of a view, by name; see ``Values``.

    A pixel shows the node, or the object, that has the largest part of its color. Id 0 is what is none of them: the
    sky, and for objects all that is no object. The layer ``lidar`` is made of the log's ``returns``, not of the scene:
    the nearest one in each pixel, of the sweep that is nearest in time, and 0 where there is none. ``seen`` needs
    ``count_images``, before the scene is edited: it is the mean count of the Gaussians in a pixel, by their weights.
    """
    rendering = stored.render(view)
    found: dict[str, Values] = {}
    for layer in layers:
        if layer == "rgb":
            found[layer] = (rendering.rgb.clamp(0, 1) * 255).round().byte().cpu().numpy()
        elif layer == "alpha":
            found[layer] = (rendering.alpha.clamp(0, 1) * 255).round().byte().cpu().numpy()
        elif layer == "depth":
            millimeters = (1000 * rendering.depth).round().clamp(1, MAX_MILLIMETERS)
            shown = torch.where(rendering.alpha >= _SOLID, millimeters, 0.0)
            found[layer] = shown.cpu().numpy().astype(np.uint16)
        elif layer == "lidar":
            if returns is None:
                raise ValueError("the layer lidar is made of a log's returns: give them")
            found[layer] = returns.millimeters(stored.scene.seen(view).camera, view.time)
        elif layer == "seen":
            found[layer] = _seen(stored, view, rendering)
        elif layer == "nodes":
            found[layer] = _shown_ids(stored, view, rendering, _node_ids(rendering)).astype(np.uint8)
        else:
            found[layer] = _shown_ids(stored, view, rendering, _instance_ids(stored, rendering)).astype(np.uint16)
    return found


def layer_picture(layer: str, values: Values, nodes: Sequence[str], under: Picture | None = None) -> Picture:
    """Return a layer in colors: near is light, ids of nodes have the colors of sheets, each object has its own.

    What few images have seen is dark.

    Returns of the lidar are dots on the picture ``under`` them, darkened to half, or on black without one.
    """
    if layer == "rgb":
        return values
    if layer == "alpha":
        return np.repeat(values[..., None], 3, axis=-1)
    if layer == "depth":
        return np.where(values[..., None] > 0, _by_distance(values), 0).astype(np.uint8)
    if layer == "seen":
        return color_map(np.log2(1.0 + values) / np.log2(1.0 + _ENOUGH_IMAGES))
    if layer == "lidar":
        dots = enlarged(values, math.ceil(values.shape[1] / _DOTS))
        return np.where(dots[..., None] > 0, _by_distance(dots), 0 if under is None else under // 2).astype(np.uint8)
    if layer == "nodes":
        colors = [(0, 0, 0), *node_legend(nodes).values()]
    else:
        # By the golden angle: neighbors differ.
        hues = [colorsys.hsv_to_rgb((0.618034 * index) % 1, 0.75, 1.0) for index in range(1, int(values.max()) + 1)]
        colors = [(0, 0, 0), *((round(255 * r), round(255 * g), round(255 * b)) for r, g, b in hues)]
    return np.array(colors, np.uint8)[values]


def _by_distance(millimeters: Values) -> Picture:
    return color_map(1 - np.log(np.maximum(millimeters, 1) / 1000 / _NEAR) / np.log(_FAR / _NEAR))


def layer_pictures(
    stored: StoredScene, path: CameraPath, layers: Sequence[str], returns: LidarReturns | None = None
) -> Iterator[Picture]:
    """Yield one picture an instant: a row of cameras for each layer, one below the other."""
    nodes, wanted = list(stored.scene.nodes), dict.fromkeys((*layers, "rgb") if "lidar" in layers else layers)
    for rig in path:
        views = [layer_values(stored, view, tuple(wanted), returns) for view in rig]
        rows = [
            side_by_side([layer_picture(layer, one[layer], nodes, one.get("rgb")) for one in views]) for layer in layers
        ]
        yield np.concatenate(rows)


def write_layers(
    out: Path,
    stored: StoredScene,
    path: CameraPath,
    layers: Sequence[str],
    shown: Iterator[int] | range,
    returns: LidarReturns | None = None,
) -> int:
    """Write a folder of PNGs for each layer, the exact values, and tables of ids; whole or not at all.

    Each camera of a rig has its own folder below if there are several. Returns the number of instants. ``shown`` runs
    over the instants. Raises OSError if the folder is not empty or cannot be written.
    """
    count = 0
    with atomic_folder(out) as temporary:
        for index in shown:
            rig = path[index]
            for place, view in enumerate(rig):
                camera = "" if len(rig) == 1 else f"camera_{place if view.camera_index is None else view.camera_index}"
                for layer, values in layer_values(stored, view, layers, returns).items():
                    folder = temporary / layer / camera
                    folder.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(values).save(folder / f"{index:05d}.png")
            count += 1
        for name, table in tables(stored, layers).items():
            (temporary / f"{name}.json").write_text(json.dumps(table, indent=1, ensure_ascii=False), encoding="utf-8")
    return count


def tables(stored: StoredScene, layers: Sequence[str]) -> Mapping[str, Any]:
    """Return what ids mean, for the layers that have some; those of objects are in the order of nodes and tracks."""
    found: dict[str, Any] = {}
    if "nodes" in layers:
        found["nodes"] = {str(number): name for number, name in enumerate(stored.scene.nodes, start=1)}
    if "instances" in layers:
        lines = [
            {"name": name, "class": kind, "node": node_name}
            for node_name, node in stored.scene.nodes.items()
            if (objects := node.instances()) is not None
            for name, kind in zip(objects.names, objects.classes or ("",) * len(objects.names), strict=True)
        ]
        found["instances"] = {str(number): line for number, line in enumerate(lines, start=1)}
    return found


def _seen(stored: StoredScene, view: View, rendering: SceneRendering) -> UInt8[np.ndarray, "h w"]:
    """Images that showed what the pixel shows, rounded; 0 also where the pixel has no depth."""
    share = images_seen(stored.scene, rendering.spans).clamp(max=_MAX_IMAGES) / _MAX_IMAGES
    summed = _splatted(stored, stored.scene.seen(view), rendering, share[:, None].expand(-1, 3))[..., 0]
    mean = _MAX_IMAGES * summed / rendering.alpha.clamp(min=_SOLID)
    return torch.where(rendering.alpha >= _SOLID, mean.round().clamp(0, _MAX_IMAGES), 0.0).byte().cpu().numpy()


def _node_ids(rendering: SceneRendering) -> Int[Tensor, " n"]:
    ids = torch.zeros(len(rendering.gaussians), dtype=torch.int64, device=rendering.alpha.device)
    for number, rows in enumerate(rendering.spans.values(), start=1):
        ids[rows] = number
    return ids


def _instance_ids(stored: StoredScene, rendering: SceneRendering) -> Int[Tensor, " n"]:
    ids = torch.zeros(len(rendering.gaussians), dtype=torch.int64, device=rendering.alpha.device)
    first = 1
    for name, rows in rendering.spans.items():
        objects = stored.scene.nodes[name].instances()
        if objects is not None:
            ids[rows] = first + objects.ids
            first += len(objects.names)
    return ids


def _shown_ids(
    stored: StoredScene, view: View, rendering: SceneRendering, ids: Int[Tensor, " n"]
) -> Int[np.ndarray, "h w"]:
    """Return the id with the largest weight at each pixel, out of those in view; the rest of the light has id 0."""
    known = [number for number in ids[rendering.splats.visible].unique().tolist() if number > 0]
    seen = stored.scene.seen(view)
    weights = []
    for start in range(0, len(known), 3):
        chunk = known[start : start + 3]
        share = torch.stack([ids == number for number in (*chunk, -1, -1)[:3]], dim=1).float()
        weights.append(_splatted(stored, seen, rendering, share)[..., : len(chunk)])
    if not weights:
        return np.zeros(rendering.alpha.shape, np.int64)
    weight = torch.cat(weights, dim=-1)
    best, place = weight.max(-1)
    chosen = torch.tensor(known, device=place.device)[place]
    return torch.where(best > 1 - weight.sum(-1), chosen, 0).cpu().numpy()


def _splatted(
    stored: StoredScene, seen: View, rendering: SceneRendering, share: Float[Tensor, "n 3"]
) -> Float[Tensor, "h w 3"]:
    """Return the sum over the Gaussians of their weight at a pixel times their share: colors without harmonics."""
    labeled = replace(rendering.gaussians, sh=of_colors(share))
    return splat(labeled, seen.camera, settings=stored.options.settings, backend=stored.options.backend).rgb
