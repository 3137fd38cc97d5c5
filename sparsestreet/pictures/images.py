"""Pictures by which a person judges a run: truth, render, error and Gaussian centers of one view.

All images are uint8 [h, w, 3]. Errors share one fixed scale, so pictures of different runs can be compared.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageFilter

ERROR_SCALE = 0.2
"""Mean absolute difference over RGB, in [0, 1], at which the error picture reaches its brightest color."""

TILE_WIDTH = 480
"""Width of a column of a sheet, pixels."""

KINDS = ("truth", "render", "error", "centers")

LIDAR_END = (0, 230, 230)
"""RGB of the line that marks the end of the lidar in error pictures; no error has this color."""

# Perceptually uniform dark-to-bright map: 17 equally spaced samples of "inferno" (van der Walt and Smith, CC0).
_INFERNO = np.array(
    [
        (0, 0, 4), (11, 7, 36), (33, 12, 74), (61, 9, 101), (87, 16, 110), (113, 25, 110), (138, 34, 106),
        (163, 44, 97), (188, 55, 84), (210, 70, 68), (228, 90, 49), (241, 115, 29), (249, 142, 9), (252, 172, 17),
        (249, 203, 53), (242, 234, 105), (252, 255, 164),
    ],
    dtype=np.float64,
)  # fmt: skip


@dataclass(frozen=True)
class Picture:
    """One recorded image with its render, error and centers."""

    frame: int
    camera: int
    truth: UInt8[np.ndarray, "h w 3"]
    render: UInt8[np.ndarray, "h w 3"]
    error: UInt8[np.ndarray, "h w 3"]
    """``error_picture`` of render and truth, with the line at the lidar's end if the log has lidar."""
    centers: UInt8[np.ndarray, "h w 3"]
    """The projected centers of the Gaussians."""

    @property
    def shows_lidar_end(self) -> bool:
        """Whether its error picture has the line at the lidar's end."""
        return bool((self.error == LIDAR_END).all(axis=-1).any())


def color_map(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
    """Return colors from black through red to pale yellow for values in [0, 1]; others are clipped.

    >>> color_map(np.array([0.0, 1.0])).tolist()
    [[0, 0, 4], [252, 255, 164]]
    """
    position = np.clip(values, 0, 1) * (len(_INFERNO) - 1)
    knots = np.arange(len(_INFERNO))
    channels = [np.interp(position, knots, _INFERNO[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def error_picture(render: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the mean absolute difference over RGB in [0, 1], divided by ``ERROR_SCALE`` and colored.

    >>> black, white = np.zeros((1, 2, 3), np.uint8), np.full((1, 2, 3), 255, np.uint8)
    >>> error_picture(black, white)[0, 0].tolist()
    [252, 255, 164]
    """
    difference = np.abs(render.astype(np.float64) - truth.astype(np.float64)).mean(axis=-1) / 255
    return color_map(difference / ERROR_SCALE)


def draw_lidar_end(
    picture: UInt8[np.ndarray, "h w 3"], near: Bool[np.ndarray, "h w"], beyond: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture with a line on the near pixels that touch a pixel beyond.

    The line is one pixel wide. It is wider in images above 720 pixels, so that a sheet's tile still shows it.
    """
    reach = max(round(picture.shape[1] / TILE_WIDTH), 1)
    touched = Image.fromarray(beyond).convert("L").filter(ImageFilter.MaxFilter(2 * reach + 1))
    return np.where((near & (np.asarray(touched) > 0))[..., None], np.array(LIDAR_END, np.uint8), picture)


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image and creates its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def picture_path(folder: Path, frame: int, camera: int, kind: str) -> Path:
    """Return the path of one image of a picture; ``kind`` is one of ``KINDS``.

    >>> picture_path(Path("pictures"), frame=7, camera=0, kind="render").name
    '007_0_render.png'
    """
    return folder / f"{frame:03d}_{camera}_{kind}.png"


def write_picture(folder: Path, picture: Picture) -> None:
    """Write truth, render, error and centers as single PNGs in their own resolution."""
    for kind in KINDS:
        write_png(picture_path(folder, picture.frame, picture.camera, kind), getattr(picture, kind))


def drawn_views(folder: Path) -> list[tuple[int, int]]:
    """Return frame and camera of each picture in a folder, in order."""
    stems = (path.stem.split("_") for path in folder.glob("*_truth.png"))
    return sorted((int(frame), int(camera)) for frame, camera, _ in stems)


def read_pictures(folder: Path) -> list[Picture]:
    """Return the pictures in a folder in order of frame and camera.

    Raises FileNotFoundError if there are none, or if a picture lacks one of its images.
    """
    views = drawn_views(folder)
    if not views:
        raise FileNotFoundError(f"{folder} has no pictures (*_truth.png): evaluate the run first")
    return [
        Picture(frame, camera, *(_read_png(picture_path(folder, frame, camera, kind)) for kind in KINDS))
        for frame, camera in views
    ]


def _read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@dataclass(frozen=True)
class Dots:
    """Groups of points in a plane."""

    title: str
    x: str
    y: str
    groups: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    """Name -> both coordinates of its points."""
    joined: bool = False
    """Whether the points of a group are a curve."""
    diagonal: bool = False
    """Whether the line on which both coordinates are equal is drawn."""


@dataclass(frozen=True)
class Marked:
    """An image of the log, of which some pixels are marked."""

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Places:
    """Values at places of an image."""

    title: str
    image: UInt8[np.ndarray, "h w 3"]
    pixels: Float[np.ndarray, "n 2"]
    values: Float[np.ndarray, " n"]
    unit: str


Panel = Dots | Marked | Places
