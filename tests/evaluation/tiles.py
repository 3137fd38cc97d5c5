"""Pictures of one color each, which are easily found in a sheet."""

import numpy as np

from sparsestreet.pictures.images import Picture, error_picture

COLORS = {"truth": (200, 10, 10), "render": (10, 200, 10), "centers": (10, 10, 200)}


def flat(color: tuple[int, int, int], height: int = 9, width: int = 13) -> np.ndarray:
    return np.full((height, width, 3), color, dtype=np.uint8)


def make_picture(frame: int = 3, camera: int = 1, render: tuple[int, int, int] = COLORS["render"]) -> Picture:
    truth = flat(COLORS["truth"])
    return Picture(frame, camera, truth, flat(render), error_picture(flat(render), truth), flat(COLORS["centers"]))
