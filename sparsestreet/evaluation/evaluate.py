"""Renders against recorded images, one at a time: nothing is kept but numbers."""

from collections.abc import Iterable, Iterator

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.data.device import to_device
from sparsestreet.data.lidar import near_returns
from sparsestreet.evaluation.quality import FrameQuality, RegionQuality
from sparsestreet.metrics import image as metrics
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import Frame, View


@torch.no_grad()
def screen_image(scene: SceneGraph, view: View, options: RenderOptions) -> Float[Tensor, "h w 3"]:
    """A view's render as a screen shows it: float32 in [0, 1], without gradients, on the scene's device.

    Raises ValueError if the render has a NaN or an infinity: clamping would turn the latter into plain white.
    """
    rgb = render(scene, view, options=options).rgb.float()
    finite = torch.isfinite(rgb)
    if not bool(finite.all()):
        raise ValueError(
            f"the render of frame {view.frame_index}, camera {view.camera_index} has {int((~finite).sum())} values "
            "that are not finite: look for Gaussians with NaN parameters in the scene"
        )
    return rgb.clamp(0, 1)


def evaluate_frames(scene: SceneGraph, frames: Iterable[Frame], options: RenderOptions) -> Iterator[FrameQuality]:
    """The quality of each frame's render, in order; holds one frame at a time, and moves it to the scene's device.

    Args:
        scene: what is rendered.
        frames: recorded views; may load its images while iterating.
        options: how it is rendered.

    Raises ValueError for a render that is not finite.
    """
    for frame in frames:
        yield frame_quality(screen_image(scene, frame, options), to_device(frame, scene.device))


def frame_quality(rgb: Float[Tensor, "h w 3"], frame: Frame) -> FrameQuality:
    """Compare one clamped render [0, 1] with the frame's image, in full and by region; both on one device."""
    truth = frame.image.float() / 255
    similarity = metrics.ssim_map(rgb, truth)
    error = metrics.mse(rgb, truth)
    height, width = frame.image.shape[:2]
    full = RegionQuality(height * width, error, metrics.psnr_of_mse(error), metrics.ssim_of_map(similarity))
    masks = {"human": frame.human, "vehicle": frame.vehicle} | lidar_masks(frame)
    parts = {name: _region_quality(rgb, truth, similarity, mask) for name, mask in masks.items() if mask is not None}
    return FrameQuality(frame.frame_index, frame.camera_index, width, height, {"full": full} | parts)


def lidar_masks(frame: Frame) -> dict[str, Bool[Tensor, "h w"]]:
    """Name -> pixels of the regions "near_lidar" and "beyond_lidar", in this order, without the sky where the frame
    knows it; nothing where the log has no lidar."""
    if frame.depth is None:
        return {}
    near = near_returns(frame.depth)
    ground = torch.ones_like(near) if frame.sky is None else ~frame.sky
    return {"near_lidar": near & ground, "beyond_lidar": ~near & ground}


def _region_quality(
    rgb: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    similarity: Float64[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
) -> RegionQuality:
    error = metrics.masked_mse(rgb, truth, mask)
    if error is None:
        return RegionQuality(0, None, None, None)
    return RegionQuality(
        int(mask.sum()), error, metrics.psnr_of_mse(error), metrics.masked_ssim_of_map(similarity, mask)
    )
