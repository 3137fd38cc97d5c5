"""Pixels that no loss sees, such as rows that show the recording car in all images of a data set, and what is left."""

import torch
from jaxtyping import Bool
from torch import Tensor

from sparsestreet.data.lazy import Frames
from sparsestreet.types import Frame


def bottom_rows(size: tuple[int, int], rows: int, recorded_height: int) -> Bool[Tensor, "h w"]:
    """True in the lowest ``rows`` of images that were recorded ``recorded_height`` rows high, at (width, height).

    A row of a scaled image that holds some of them is among them.
    """
    width, height = size
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[(recorded_height - rows) * height // recorded_height :] = True
    return mask


def used_share(frame: Frame) -> float:
    """Return the share of an image's pixels that losses see."""
    return 1.0 if frame.ego is None else float((~frame.ego).float().mean())


def check_used(frames: Frames, name: str) -> None:
    """Raise ValueError where no pixel of any image is used; ``name`` is the log's. Images are decoded up to the first
    that has one."""
    if len(frames) and not any(used_share(frame) for frame in frames):
        raise ValueError(
            f"{len(frames)} of {len(frames)} images of {name!r} have no pixel that is used, because masks or alpha "
            "leave all of them out: turn the masks round (mask_path: black is not used; ego masks: white is not used)"
        )
