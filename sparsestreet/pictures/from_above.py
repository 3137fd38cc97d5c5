"""Objects of a drive from above, and their boxes in images (no torch)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from sparsestreet.atomic import atomic_file

COLORS = {"vehicle": "#0072B2", "cyclist": "#009E73", "pedestrian": "#D55E00"}
"""Of Okabe and Ito's palette, which any color vision tells apart."""
_DRIVEN, _STILL = "#333333", "#c4c4c4"
_MARGIN = 12.0
"""Meters around what is shown."""
_ASPECT = 0.75
_MIN_PART = 24
"""Pixels of a part of an image, at least."""
_DRAWN = 240
"""Pixels that its width is scaled to at least, before lines are drawn."""
_EDGES = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Of ``BOX_CORNERS``."""
BOX_CORNERS = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)]) / 2
"""Of a box with sides of 1; the first four are in front."""


@dataclass(frozen=True)
class Moving:
    """An object as a map shows it."""

    name: str
    kind: str
    """One of ``COLORS``."""
    poses: Float64[np.ndarray, "f 4 4"]
    """world_from_object."""
    size: Float64[np.ndarray, "3"]
    points: Float64[np.ndarray, "n 3"]
    """The returns in its boxes, world."""


def draw_from_above(
    path: Path,
    title: str,
    objects: Sequence[Moving],
    still: Float64[np.ndarray, "n 3"],
    driven: Float64[np.ndarray, "p 3"],
) -> None:
    """Write a PNG: returns of what stands still, the path driven, and of each object its returns, path and last box.

    Args:
        path: of the file.
        title: above it.
        objects: all that moved; none at all is no error.
        still: returns in no box.
        driven: places of the recording car; the map is turned so that it drives to the right.
    """
    turn = _to_the_right(driven[:, :2])
    places = [driven[:, :2], *(each.poses[:, :2, 3] for each in objects)]
    shown = np.concatenate(places) @ turn.T
    low, high = shown.min(0) - _MARGIN, shown.max(0) + _MARGIN
    wide, tall = high - low
    figure = Figure(figsize=(14.0, float(np.clip(14.0 * tall / wide, 3.0, 12.0)) + 0.8), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    axes.scatter(*(still[:, :2] @ turn.T).T, s=0.4, c=_STILL, linewidths=0, rasterized=True)
    axes.plot(*(driven[:, :2] @ turn.T).T, color=_DRIVEN, linewidth=1.2, linestyle="--", label="recording car")
    for each in objects:
        _draw(axes, each, turn)
    for kind, color in COLORS.items():
        count = sum(each.kind == kind for each in objects)
        if count:
            axes.plot([], [], color=color, linewidth=2, label=f"{kind} ({count})")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", title=title)
    axes.set_xlabel("meters along the drive")
    axes.set_ylabel("meters to its left")
    axes.legend(frameon=True, fontsize=9, loc="best")
    with atomic_file(path) as file:
        figure.savefig(file, format="png")


def _draw(axes: Axes, each: Moving, turn: Float64[np.ndarray, "2 2"]) -> None:
    color = COLORS[each.kind]
    axes.scatter(*(each.points[:, :2] @ turn.T).T, s=1.5, c=color, alpha=0.35, linewidths=0, rasterized=True)
    middles = each.poses[:, :2, 3] @ turn.T
    axes.plot(*middles.T, color=color, linewidth=1.3)
    outlines = [_outline(each.poses[place], each.size) @ turn.T for place in (0, -1)]
    axes.add_collection(LineCollection(outlines, colors=color, linewidths=(0.8, 1.6)))
    said = axes.annotate(each.name, middles[-1], xytext=(4, 4), textcoords="offset points", fontsize=8, color=color)
    said.set_bbox({"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.5})


def _outline(pose: Float64[np.ndarray, "4 4"], size: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 2"]:
    """The box in plan, with a line from its middle to its front."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1], [1, 0], [0, 0]]) * size[:2] / 2
    return pose[:2, 3] + corners @ pose[:2, :2].T


def _to_the_right(driven: Float64[np.ndarray, "p 2"]) -> Float64[np.ndarray, "2 2"]:
    """The turn that lays the way from the first to the last place along x; none where the car stood."""
    ahead = driven[-1] - driven[0]
    length = float(np.hypot(*ahead))
    x, y = ahead / length if length > 1.0 else (1.0, 0.0)
    return np.array([[x, y], [-y, x]])


def box_in_image(
    image: UInt8[np.ndarray, "h w 3"], corners: Float64[np.ndarray, "8 2"], kind: str, around: float = 1.5
) -> UInt8[np.ndarray, "a b 3"]:
    """Return the part of an image around a box, three quarters as high as it is wide, with the box drawn on it.

    The lines of its front are thicker.

    Args:
        image: whole.
        corners: pixels of ``BOX_CORNERS``, those of a box in front of the camera.
        kind: of the object.
        around: sides of the part, of those of the box; where the image ends there is less.
    """
    wide, tall = around * (corners.max(0) - corners.min(0))
    size = np.maximum(np.ceil([max(wide, tall / _ASPECT), max(tall, wide * _ASPECT)]), _MIN_PART).astype(int)
    size = np.minimum(size, (image.shape[1], image.shape[0]))
    middle = (corners.max(0) + corners.min(0)) / 2
    left, top = np.clip(np.floor(middle - size / 2).astype(int), 0, (image.shape[1], image.shape[0]) - size)
    part = image[top : top + size[1], left : left + size[0]]
    scale = max(1, -(-_DRAWN // int(size[0])))
    drawn = Image.fromarray(part).resize((int(size[0]) * scale, int(size[1]) * scale), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(drawn)
    ends = [tuple(map(float, point)) for point in (corners - (left, top)) * scale]
    for place, (one, other) in enumerate(_EDGES):
        draw.line((*ends[one], *ends[other]), fill=COLORS[kind], width=2 if place < 4 else 1)
    return np.asarray(drawn)


def kinds_in_words(counts: Mapping[str, int]) -> str:
    """Return "3 vehicles, 1 cyclist"; "nothing" for none."""
    said = [f"{count} {kind}{'' if count == 1 else 's'}" for kind, count in counts.items() if count]
    return ", ".join(said) or "nothing"
