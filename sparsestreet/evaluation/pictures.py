"""Pictures that let a person judge a run: truth, render, error and Gaussian centers of one view (no torch).

All images are uint8 [h, w, 3]. Errors share one fixed scale, so that pictures of different runs compare.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

ERROR_SCALE = 0.2
"""Mean absolute difference over RGB, in [0, 1], at which the error picture reaches its brightest color."""

KINDS = ("truth", "render", "error", "centers")

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
    """One recorded image with what a run made of it."""

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
