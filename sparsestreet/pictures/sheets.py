"""Sheets of pictures, of one run or of several runs side by side.

Every sheet shows the scale of its errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from sparsestreet.atomic import atomic_file
from sparsestreet.pictures.images import ERROR_SCALE, LIDAR_END, TILE_WIDTH, Picture, color_map
from sparsestreet.records.costs import COSTS, CostRecord
from sparsestreet.records.run import RUN, EffectDecision

Legend = Mapping[str, tuple[int, int, int]]
"""Node -> RGB in [0, 255] of its centers."""

_INK, _PAPER, _QUIET = (235, 235, 235), (24, 24, 27), (160, 160, 165)
_GAP, _HEADING, _MARGIN = 6, 26, 10


@dataclass(frozen=True)
class SheetColumn:
    """One run of a comparison: its pictures and the text above them."""

    label: str
    """Text above its renders, such as "streetgs+paper, 31.31 dB"."""
    size: str
    """Text above its centers, such as "45,781 Gaussians (33 %)"."""
    pictures: Sequence[Picture]
    psnr: Sequence[float]
    """PSNR of each picture, dB."""


@dataclass(frozen=True)
class Tile:
    """One image of a sheet and the text above it."""

    heading: str
    image: UInt8[np.ndarray, "h w 3"]


def picture_sheet(
    pictures: Sequence[Picture], *, title: str, legend: Legend | None = None, tile_width: int = TILE_WIDTH
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """Return a sheet with one line per picture and the columns truth, render, error, centers.

    Args:
        pictures: at least one.
        title: text on top, e.g. method, scene and PSNR.
        legend: node -> its color in the centers, drawn at the foot.
        tile_width: pixels of each column; images are scaled to it.
    """
    lines: list[list[Tile | None]] = [
        [
            Tile(f"truth: {_view(picture)}", picture.truth),
            Tile("render", picture.render),
            Tile("error", picture.error),
            Tile("Gaussian centers", picture.centers),
        ]
        for picture in pictures
    ]
    return _sheet(lines, title, legend or {}, tile_width, any(picture.shows_lidar_end for picture in pictures))


def comparison_sheet(
    columns: Sequence[SheetColumn], *, title: str, legend: Legend | None = None, tile_width: int = TILE_WIDTH
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """Return a sheet that compares runs on the same images, one column each.

    Every picture has a line of renders next to the truth, a line of errors and a line of centers. Raises ValueError for
    fewer than two runs, or if they show different images.
    """
    if len(columns) < 2:
        raise ValueError(f"a comparison needs at least two runs, got {len(columns)}")
    views = [[(picture.frame, picture.camera) for picture in column.pictures] for column in columns]
    if any(shown != views[0] for shown in views):
        raise ValueError(f"the runs show different images, (frame, camera) {views}: evaluate them alike")
    lines: list[list[Tile | None]] = []
    for index, first in enumerate(columns[0].pictures):
        pictures = [column.pictures[index] for column in columns]
        both = list(zip(columns, pictures, strict=True))
        truth = Tile(f"truth: {_view(first)}", first.truth)
        lines.append([truth, *(Tile(column.label, picture.render) for column, picture in both)])
        lines.append(
            [None, *(Tile(f"error: {one.psnr[index]:.2f} dB in this image", picture.error) for one, picture in both)]
        )
        lines.append([None, *(Tile(column.size, picture.centers) for column, picture in both)])
    lidar_end = any(picture.shows_lidar_end for picture in columns[0].pictures)
    return _sheet(lines, title, legend or {}, tile_width, lidar_end)


def _view(picture: Picture) -> str:
    return f"frame {picture.frame}, camera {picture.camera}"


def tile_sheet(tiles: Sequence[Tile], *, title: str, columns: int, tile_width: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return a sheet of tiles in lines of so many, under a title."""
    lines: list[list[Tile | None]] = [list(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    return np.asarray(_laid_out(lines, title, tile_width, foot=0)[0])


def _sheet(
    lines: list[list[Tile | None]], title: str, legend: Legend, tile_width: int, lidar_end: bool
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """Lays tiles out, with scale and legend at the foot."""
    paper, top = _laid_out(lines, title, tile_width, foot=3 if legend else 2)
    draw = ImageDraw.Draw(paper)
    _draw_scale(paper, draw, _MARGIN, top + 14, lidar_end)
    _draw_legend(draw, legend, _MARGIN, top + 14 + _HEADING)
    return np.asarray(paper)


def _laid_out(lines: list[list[Tile | None]], title: str, tile_width: int, foot: int) -> tuple[Image.Image, int]:
    """Lays tiles out on dark paper under their headings, with the title on top, and says where the foot begins."""
    if not lines:
        raise ValueError("a sheet needs at least one picture")
    heights = [max(_fitted(tile.image, tile_width).height for tile in line if tile) for line in lines]
    width = max(len(line) for line in lines) * (tile_width + _GAP) - _GAP + 2 * _MARGIN
    paper = Image.new("RGB", (width, _HEADING + sum(heights) + (len(lines) + foot) * _HEADING), _PAPER)
    draw = ImageDraw.Draw(paper)
    _write(draw, (_MARGIN, 5), title, _INK, 16, width - 2 * _MARGIN)
    top = _HEADING
    for line, height in zip(lines, heights, strict=True):
        for column, tile in enumerate(line):
            if tile is not None:
                x = _MARGIN + column * (tile_width + _GAP)
                _write(draw, (x, top + 6), tile.heading, _INK, 14, tile_width)
                paper.paste(_fitted(tile.image, tile_width), (x, top + _HEADING))
        top += _HEADING + height
    return paper, top


def _draw_scale(paper: Image.Image, draw: ImageDraw.ImageDraw, x: int, y: int, lidar_end: bool) -> None:
    """Draw the error colors with their values, and the meaning of the line at the lidar's end."""
    x = _write(draw, (x, y), "error: |render - truth|, mean over RGB, values in [0, 1]:   0", _QUIET, 13) + 8
    bar = color_map(np.broadcast_to(np.linspace(0, 1, 160), (16, 160)).copy())
    paper.paste(Image.fromarray(bar), (x, y))
    draw.rectangle((x - 1, y - 1, x + 160, y + 16), outline=_QUIET)
    x = _write(draw, (x + 168, y), f"{ERROR_SCALE:g} or more", _QUIET, 13) + 20
    if lidar_end:
        draw.line((x, y + 8, x + 20, y + 8), fill=LIDAR_END)
        _write(draw, (x + 28, y), "where the lidar ends", _QUIET, 13)


def _draw_legend(draw: ImageDraw.ImageDraw, legend: Legend, x: int, y: int) -> None:
    """Write the names of the nodes in the colors of their centers."""
    if legend:
        x = _write(draw, (x, y), "centers:", _QUIET, 13) + 12
    for name, color in legend.items():
        draw.rectangle((x, y + 3, x + 10, y + 13), fill=color)
        x = _write(draw, (x + 16, y), name, _QUIET, 13) + 20


def _fitted(image: UInt8[np.ndarray, "h w 3"], width: int) -> Image.Image:
    """Return the image scaled to the tile's width; small images keep hard pixels, so scaling adds no blur."""
    height = max(round(image.shape[0] * width / image.shape[1]), 1)
    filter_ = Image.Resampling.LANCZOS if width < image.shape[1] else Image.Resampling.NEAREST
    return Image.fromarray(image).resize((width, height), filter_)


def _write(
    draw: ImageDraw.ImageDraw,
    position: tuple[int, int],
    text: str,
    color: tuple[int, int, int],
    size: int,
    room: int | None = None,
) -> int:
    """Write a line and return where it ends; if ``room`` is short, the type shrinks (not below 8 pixels)."""
    while room is not None and size > 8 and draw.textlength(text, font=_font(size)) > room:
        size -= 1
    draw.text(position, text, fill=color, font=_font(size))
    return position[0] + round(draw.textlength(text, font=_font(size)))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


_ON, _OFF, _PREDICTED = "#3465a4", "#c8c8c8", "#555555"
_GAINS = (("full", "full image", "#3465a4"), ("vehicle", "vehicles", "#e07b00"), ("human", "people", "#4e9a06"))


def draw_effects(run: Path) -> None:
    """Write ``pictures/effects.png``: a row for each effect of the plan, its milliseconds and its gain.

    A run without a plan or without measured costs gets no picture. Raises RecordError for a malformed record.
    """
    description, costs = RUN.find(run), COSTS.find(run)
    if description is None or costs is None or not description.effects:
        return
    plan = description.effects[::-1]  # the first on top
    figure = Figure(figsize=(9.0, 1.5 + 0.5 * len(plan)), layout="constrained")
    times, gains = figure.subplots(1, 2, sharey=True)
    _times(times, plan, costs)
    _gains(gains, plan, costs)
    times.set_yticks(range(len(plan)), [f"{one.name} ({'on' if one.on else 'off'}, {one.source})" for one in plan])
    figure.suptitle(f"{description.label} on {description.scene}: what the effects cost and bring", fontsize=10)
    with atomic_file(run / "pictures" / "effects.png") as file:
        figure.savefig(file, dpi=110)


def _times(axes: Axes, plan: Sequence[EffectDecision], costs: CostRecord) -> None:
    for row, one in enumerate(plan):
        axes.barh(row, costs.effects.get(one.name, 0.0), height=0.5, color=_ON if one.on else _OFF)
        axes.plot([one.ms, one.ms], [row - 0.3, row + 0.3], color=_PREDICTED, linestyle="-" if one.on else ":")
    axes.plot([], [], color=_PREDICTED, label="predicted")
    axes.legend(fontsize=7, loc="lower right")
    axes.set_xlabel("additional ms of a frame")


def _gains(axes: Axes, plan: Sequence[EffectDecision], costs: CostRecord) -> None:
    for row, one in enumerate(plan):
        gain = costs.gains.get(one.name)
        for place, (field, _, color) in enumerate(_GAINS):
            value = None if gain is None else getattr(gain, field)
            axes.barh(row + 0.2 - 0.2 * place, value or 0.0, height=0.18, color=color)
        if one.gain is not None:
            axes.plot([one.gain, one.gain], [row - 0.3, row + 0.3], color=_PREDICTED, linestyle="-" if one.on else ":")
    for _, label, color in _GAINS:
        axes.barh(0, 0.0, color=color, label=label)
    axes.legend(fontsize=7, loc="lower right")
    axes.set_xlabel("PSNR with the effect less without it, dB")
