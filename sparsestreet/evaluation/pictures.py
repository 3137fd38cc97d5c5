"""Pictures that let a person judge a run: truth, render, error and Gaussian centers side by side (no torch).

All images are uint8 [h, w, 3]. Errors share one fixed scale, written on every sheet, so that two sheets compare.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

ERROR_SCALE = 0.2
"""Mean absolute difference over RGB, in [0, 1], at which the error picture reaches its brightest color."""

KINDS = ("truth", "render", "error", "centers")

Legend = Mapping[str, tuple[int, int, int]]
"""Node class -> RGB in [0, 255] of its centers."""

# Perceptually uniform dark-to-bright map: 17 equally spaced samples of "inferno" (van der Walt and Smith, CC0).
_INFERNO = np.array(
    [
        (0, 0, 4), (11, 7, 36), (33, 12, 74), (61, 9, 101), (87, 16, 110), (113, 25, 110), (138, 34, 106),
        (163, 44, 97), (188, 55, 84), (210, 70, 68), (228, 90, 49), (241, 115, 29), (249, 142, 9), (252, 172, 17),
        (249, 203, 53), (242, 234, 105), (252, 255, 164),
    ],
    dtype=np.float64,
)  # fmt: skip

_INK, _PAPER, _QUIET = (235, 235, 235), (24, 24, 27), (160, 160, 165)
_GAP, _HEADING, _MARGIN = 6, 26, 10


@dataclass(frozen=True)
class Picture:
    """One held-out image with what a run made of it."""

    frame: int
    camera: int
    truth: UInt8[np.ndarray, "h w 3"]
    render: UInt8[np.ndarray, "h w 3"]
    centers: UInt8[np.ndarray, "h w 3"]
    """The Gaussians' centers, projected."""

    @property
    def error(self) -> UInt8[np.ndarray, "h w 3"]:
        """The colored absolute difference of render and truth, on the common scale."""
        return error_picture(self.render, self.truth)


@dataclass(frozen=True)
class Tile:
    """One image of a sheet and what is written above it."""

    heading: str
    image: UInt8[np.ndarray, "h w 3"]


def color_map(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Values in [0, 1] (clipped) as colors from black through red to pale yellow."""
    position = np.clip(values, 0, 1) * (len(_INFERNO) - 1)
    knots = np.arange(len(_INFERNO))
    channels = [np.interp(position, knots, _INFERNO[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def error_picture(
    render: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"], scale: float = ERROR_SCALE
) -> UInt8[np.ndarray, "h w 3"]:
    """Mean absolute difference over RGB in [0, 1], divided by ``scale`` and colored."""
    difference = np.abs(render.astype(np.float64) - truth.astype(np.float64)).mean(axis=-1) / 255
    return color_map(difference / scale)


def picture_sheet(
    pictures: Sequence[Picture], *, title: str, legend: Legend | None = None, tile_width: int = 480
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """A sheet with one line per picture and the columns truth, render, error, centers.

    Args:
        pictures: at least one.
        title: printed on top, e.g. method, scene and PSNR.
        legend: node class -> its color in the centers, drawn at the foot.
        tile_width: pixels of each column; images are scaled to it.
    """
    headings = ("render", "error", "Gaussian centers")
    lines = [
        [
            Tile(f"truth: {_view(picture)}", picture.truth),
            *(Tile(*pair) for pair in zip(headings, _outcome(picture), strict=True)),
        ]
        for picture in pictures
    ]
    return _sheet(lines, title, legend or {}, tile_width)


def comparison_sheet(
    plain: Sequence[Picture],
    ours: Sequence[Picture],
    *,
    plain_label: str,
    ours_label: str,
    plain_count: int,
    ours_count: int,
    title: str,
    legend: Legend | None = None,
    tile_width: int = 480,
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """Two runs on the same images, one below the other: truth, renders, errors, centers before and after pruning.

    Each picture takes two lines, so that the two renders (errors, centers) stand above each other at readable size.
    Raises ValueError if the two runs show different images.
    """
    views, other_views = ([(picture.frame, picture.camera) for picture in run] for run in (plain, ours))
    if views != other_views:
        raise ValueError(f"the runs show different images, (frame, camera) {views} and {other_views}: evaluate alike")
    kept = f"{ours_count:,} Gaussians ({100 * ours_count / max(plain_count, 1):.0f} %)"
    headings = (f"render: {plain_label}", f"error: {plain_label}", f"centers before: {plain_count:,} Gaussians")
    our_headings = (f"render: {ours_label}", f"error: {ours_label}", f"centers after: {kept}")
    lines = []
    for before, after in zip(plain, ours, strict=True):
        tiles = [Tile(*pair) for pair in zip(headings, _outcome(before), strict=True)]
        lines.append([Tile(f"truth: {_view(before)}", before.truth), *tiles])
        lines.append([None, *(Tile(*pair) for pair in zip(our_headings, _outcome(after), strict=True))])
    return _sheet(lines, title, legend or {}, tile_width)


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image, creating the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def picture_path(folder: Path, frame: int, camera: int, kind: str) -> Path:
    """Where one image of a picture lies; ``kind`` is one of ``KINDS``."""
    return folder / f"{frame:03d}_{camera}_{kind}.png"


def write_picture(folder: Path, picture: Picture) -> None:
    """Write truth, render, error and centers as single PNGs in their own resolution."""
    images = (picture.truth, picture.render, picture.error, picture.centers)
    for kind, image in zip(KINDS, images, strict=True):
        write_png(picture_path(folder, picture.frame, picture.camera, kind), image)


def read_pictures(folder: Path) -> list[Picture]:
    """The pictures that a run left in its folder, in order of frame and camera.

    Raises FileNotFoundError if there are none, or one lacks its render or centers.
    """
    suffix = "_truth.png"
    keys = sorted(
        tuple(int(part) for part in path.name.removesuffix(suffix).split("_")) for path in folder.glob(f"*{suffix}")
    )
    if not keys:
        raise FileNotFoundError(f"{folder} has no pictures (*{suffix}): evaluate the run first")
    return [
        Picture(
            frame, camera, *(_read_png(picture_path(folder, frame, camera, kind)) for kind in KINDS if kind != "error")
        )
        for frame, camera in keys
    ]


def _read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _view(picture: Picture) -> str:
    return f"frame {picture.frame}, camera {picture.camera}"


def _outcome(picture: Picture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return picture.render, picture.error, picture.centers


def _sheet(
    lines: list[list[Tile | None]], title: str, legend: Legend, tile_width: int
) -> UInt8[np.ndarray, "sheet_h sheet_w 3"]:
    """Lay tiles out on dark paper under their headings; the title on top, scale and legend at the foot."""
    if not lines:
        raise ValueError("a sheet needs at least one picture")
    heights = [max(_fitted(tile.image, tile_width).height for tile in line if tile) for line in lines]
    width = max(len(line) for line in lines) * (tile_width + _GAP) - _GAP + 2 * _MARGIN
    paper = Image.new("RGB", (width, _HEADING + sum(heights) + (len(lines) + (3 if legend else 2)) * _HEADING), _PAPER)
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
    _draw_scale(paper, draw, _MARGIN, top + 14)
    _draw_legend(draw, legend, _MARGIN, top + 14 + _HEADING)
    return np.asarray(paper)


def _draw_scale(paper: Image.Image, draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    """The error colors with their values."""
    x = _write(draw, (x, y), "error: |render - truth|, mean over RGB, values in [0, 1]:   0", _QUIET, 13) + 8
    bar = color_map(np.broadcast_to(np.linspace(0, 1, 160), (16, 160)).copy())
    paper.paste(Image.fromarray(bar), (x, y))
    draw.rectangle((x - 1, y - 1, x + 160, y + 16), outline=_QUIET)
    _write(draw, (x + 168, y), f"{ERROR_SCALE:g} or more", _QUIET, 13)


def _draw_legend(draw: ImageDraw.ImageDraw, legend: Legend, x: int, y: int) -> None:
    """The node classes in the colors of their centers."""
    if legend:
        x = _write(draw, (x, y), "centers:", _QUIET, 13) + 12
    for name, color in legend.items():
        draw.rectangle((x, y + 3, x + 10, y + 13), fill=color)
        x = _write(draw, (x + 16, y), name, _QUIET, 13) + 20


def _fitted(image: UInt8[np.ndarray, "h w 3"], width: int) -> Image.Image:
    """Scaled to the tile's width; small images keep hard pixels so that nobody takes blur for the render's."""
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
    """Write a line and return where it ends; short of room the type shrinks (not below 8 pixels)."""
    while room is not None and size > 8 and draw.textlength(text, font=_font(size)) > room:
        size -= 1
    draw.text(position, text, fill=color, font=_font(size))
    return position[0] + round(draw.textlength(text, font=_font(size)))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
