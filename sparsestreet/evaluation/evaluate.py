"""Renders against held-out images, one at a time: nothing is kept but numbers."""

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.evaluation.quality import FrameQuality, RegionQuality
from sparsestreet.metrics import image as metrics
from sparsestreet.types import Frame


class RenderedImage(Protocol):
    """What evaluation needs of a rendering."""

    @property
    def rgb(self) -> Tensor:
        """Float [h, w, 3]; values outside [0, 1] are clamped, as a screen would."""


def clamped_render(render: Callable[[Frame], RenderedImage], frame: Frame) -> Float[Tensor, "h w 3"]:
    """The frame's render as a screen shows it: float32 in [0, 1], without gradients.

    Raises ValueError if the render has a NaN or an infinity: clamping would turn the latter into plain white.
    """
    with torch.no_grad():
        rgb = render(frame).rgb.detach().float()
    finite = torch.isfinite(rgb)
    if not bool(finite.all()):
        raise ValueError(
            f"the render of frame {frame.frame_index}, camera {frame.camera_index} has {int((~finite).sum())} values "
            "that are not finite: look for rows with NaN parameters in the scene"
        )
    return rgb.clamp(0, 1)


def evaluate_frames(render: Callable[[Frame], RenderedImage], frames: Iterable[Frame]) -> Iterator[FrameQuality]:
    """The quality of each frame's render, in order; holds one frame at a time.

    Args:
        render: a frame to its rendering, of the frame's own size.
        frames: held-out frames; may load its images while iterating.

    Raises ValueError for a render that is not finite or of another size than the image.
    """
    for frame in frames:
        yield frame_quality(clamped_render(render, frame), frame)


def frame_quality(rgb: Float[Tensor, "h w 3"], frame: Frame) -> FrameQuality:
    """Compare one clamped render [0, 1] with the frame's image, in full and within its masks."""
    truth = frame.image.to(rgb.device).float() / 255
    similarity = metrics.ssim_map(rgb, truth)
    error = metrics.mse(rgb, truth)
    height, width = frame.image.shape[:2]
    full = RegionQuality(height * width, error, metrics.psnr_of_mse(error), metrics.ssim_of_map(similarity))
    return FrameQuality(
        frame.frame_index,
        frame.camera_index,
        width,
        height,
        full,
        human=None if frame.human is None else _region_quality(rgb, truth, similarity, frame.human),
        vehicle=None if frame.vehicle is None else _region_quality(rgb, truth, similarity, frame.vehicle),
    )


def _region_quality(
    rgb: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    similarity: Float64[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
) -> RegionQuality:
    mask = mask.to(rgb.device)
    error = metrics.masked_mse(rgb, truth, mask)
    if error is None:
        return RegionQuality(0, None, None, None)
    return RegionQuality(
        int(mask.sum()), error, metrics.psnr_of_mse(error), metrics.masked_ssim_of_map(similarity, mask)
    )
