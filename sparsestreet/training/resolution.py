"""Smaller images at the start of a training, as DriveStudio has it: coarse things first, at a fraction of the time."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from sparsestreet.geometry.cameras import resized
from sparsestreet.training.schedule import ROUNDING, Course
from sparsestreet.types import Frame

LEAST_SIDE = 11
"""Pixels: SSIM's window. Images are not made smaller than this."""


@dataclass(frozen=True)
class ResolutionSchedule:
    """Sides of 1 / 2^halvings at first, which double after each ``double_in`` of the run until they are whole.

    Raises ValueError for a negative number of halvings or an interval that is not positive.

    >>> schedule = ResolutionSchedule(halvings=2, double_in=0.1)
    >>> [schedule.divisor(step, Course(100)) for step in (0, 9, 10, 20)]
    [4, 4, 2, 1]
    """

    halvings: int = 0
    """0: all images are whole."""
    double_in: float = 0.00833

    def __post_init__(self) -> None:
        if self.halvings < 0 or not self.double_in > 0:
            raise ValueError(
                f"a resolution schedule needs halvings >= 0 and double_in > 0, got {self.halvings} and {self.double_in}"
            )

    def divisor(self, step: int, course: Course) -> int:
        """Returns by what the sides of the images of a step (0 is the first) are divided."""
        doubled = int(course.progress(step) / self.double_in + ROUNDING)
        return 2 ** max(self.halvings - doubled, 0)

    def of(self, frame: Frame, step: int, course: Course) -> Frame:
        """Returns the frame as a step trains on it; whole, it is the same object."""
        if not self.halvings:
            return frame
        side = min(frame.camera.width, frame.camera.height)
        divisor = min(self.divisor(step, course), max(side // LEAST_SIDE, 1))
        return frame if divisor == 1 else smaller(frame, divisor)


def smaller(frame: Frame, divisor: int) -> Frame:
    """Returns the frame with sides of a ``divisor``-th, rounded down to whole pixels.

    Images are resized by an antialiased bicubic filter, masks take the nearest pixel, a depth is the mean of the
    returns in its part of the image.
    """
    size = (frame.camera.height // divisor, frame.camera.width // divisor)
    masks = {name: getattr(frame, name) for name in ("sky", "human", "vehicle", "ego")}
    return replace(
        frame,
        camera=resized(frame.camera, *size),
        image=_image(frame.image, size),
        depth=None if frame.depth is None else _depth(frame.depth, size),
        **{name: None if mask is None else _mask(mask, size) for name, mask in masks.items()},
    )


def _image(image: UInt8[Tensor, "h w 3"], size: tuple[int, int]) -> UInt8[Tensor, "_ _ 3"]:
    values = image.permute(2, 0, 1)[None].float()
    small = interpolate(values, size, mode="bicubic", antialias=True, align_corners=False)
    return small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).contiguous()


def _mask(mask: Bool[Tensor, "h w"], size: tuple[int, int]) -> Bool[Tensor, "_ _"]:
    return interpolate(mask[None, None].float(), size, mode="nearest")[0, 0] > 0


def _depth(depth: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "_ _"]:
    total, hits = (interpolate(each[None, None], size, mode="area")[0, 0] for each in (depth, (depth > 0).to(depth)))
    return torch.where(hits > 0, total / hits.clamp(min=1e-12), 0.0)
