"""Renders against recorded images, one at a time: nothing is kept but numbers, and predictions on disk."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt16
from torch import Tensor

from sparsestreet.data.device import to_device
from sparsestreet.data.lazy import Frames
from sparsestreet.data.lidar import near_returns
from sparsestreet.evaluation.predictions import Predictions, quantized, restored
from sparsestreet.metrics import image as metrics
from sparsestreet.metrics import ssim
from sparsestreet.metrics.definitions import GAUSS_WINDOW, LPIPS_SIDES, quantities_of
from sparsestreet.metrics.lpips import Lpips, lpips_of_layers, masked_lpips_of_layers
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.summary import FrameQuality, RegionQuality
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


def evaluate_frames(
    scene: SceneGraph,
    frames: Iterable[Frame],
    options: RenderOptions,
    predictions: Predictions | None = None,
    lpips: Mapping[str, Lpips] | None = None,
    ranks: Ranks = ALONE,
) -> Iterator[FrameQuality]:
    """The quality of each frame's render, in order; holds one frame at a time, and moves it to the scene's device.

    Of several processes each renders its share, and all get the quality of all frames: the same bits as of one process,
    because every image is measured alone.

    Args:
        scene: what is rendered.
        frames: recorded views; may load its images while iterating.
        options: how it is rendered.
        predictions: where renders are stored; what is compared is then read back from there. None: they
            are rounded alike, and not stored.
        lpips: the perceptual distances to measure, by the quantity that each is; on the scene's device.
        ranks: the processes that evaluate together; the first one alone writes.

    Raises ValueError for a render that is not finite (in all processes), OSError where a prediction cannot be written,
    LostProcessError.
    """
    if ranks.size > 1:
        views = frames if isinstance(frames, Frames) else Frames.of(tuple(frames))
        yield from _of_all(scene, views, options, predictions, lpips, ranks)
        return
    for frame in frames:
        pixels = quantized(screen_image(scene, frame, options).cpu().numpy())
        if predictions is not None:
            predictions.write(*frame.indices, pixels)
            pixels = predictions.read(*frame.indices)
        yield _quality(pixels, frame, scene.device, lpips)


def _of_all(
    scene: SceneGraph,
    frames: Frames,
    options: RenderOptions,
    predictions: Predictions | None,
    lpips: Mapping[str, Lpips] | None,
    ranks: Ranks,
) -> Iterator[FrameQuality]:
    """A round takes a frame of each process, whose pixels travel to the first: only its disk need hold the run."""

    def look(place: int) -> tuple[np.ndarray | None, FrameQuality] | ValueError | None:
        if place >= len(frames):
            return None
        frame = frames[place]
        try:
            pixels = quantized(screen_image(scene, frame, options).cpu().numpy())
        except ValueError as error:
            return error
        return (None if predictions is None else pixels), _quality(pixels, frame, scene.device, lpips)

    for first in range(0, len(frames), ranks.size):
        for found in ranks.gathered(look(first + ranks.rank)):
            if isinstance(found, ValueError):
                raise found
            if found is None:
                continue
            pixels, quality = found
            if predictions is not None and ranks.rank == 0:
                predictions.write(quality.frame, quality.camera, pixels)
            yield quality


def evaluate_predictions(
    predictions: Predictions,
    frames: Iterable[Frame],
    device: torch.device,
    lpips: Mapping[str, Lpips] | None = None,
) -> Iterator[FrameQuality]:
    """The quality of stored predictions of frames, without the scene; otherwise as ``evaluate_frames``.

    Raises PredictionError for a prediction that is absent or damaged.
    """
    for frame in frames:
        pixels = predictions.read(*frame.indices)
        yield _quality(pixels, frame, device, lpips)


def _quality(
    pixels: UInt16[np.ndarray, "h w 3"], frame: Frame, device: torch.device, lpips: Mapping[str, Lpips] | None
) -> FrameQuality:
    return frame_quality(torch.from_numpy(restored(pixels)).to(device), to_device(frame, device), lpips or {})


@torch.no_grad()
def frame_quality(rgb: Float[Tensor, "h w 3"], frame: Frame, lpips: Mapping[str, Lpips]) -> FrameQuality:
    """Compare one clamped render [0, 1] with the frame's image, in full and by region; both on one device."""
    height, width = frame.image.shape[:2]
    measured = _Measured(rgb, frame.image.float() / 255, lpips)
    regions = {name: measured.within(name, mask) for name, mask in region_masks(frame).items()}
    return FrameQuality(*frame.indices, width, height, {"full": measured.whole()} | regions)


def region_masks(frame: Frame) -> dict[str, Bool[Tensor, "h w"]]:
    """Name -> pixels of the regions that the frame knows, less "full"."""
    shown = torch.ones(frame.image.shape[:2], dtype=torch.bool, device=frame.image.device)
    masks = {"no_hood": shown if frame.ego is None else ~frame.ego}
    masks |= {name: mask for name, mask in (("human", frame.human), ("vehicle", frame.vehicle)) if mask is not None}
    if frame.human is not None and frame.vehicle is not None:
        masks["static"] = ~(frame.human | frame.vehicle)
    if frame.sky is not None:
        masks["no_sky"] = ~frame.sky
    return masks | lidar_masks(frame)


def lidar_masks(frame: Frame) -> dict[str, Bool[Tensor, "h w"]]:
    """Name -> pixels of the regions "near_lidar" and "beyond_lidar", in this order, without the sky and the recording
    car where the frame knows them; nothing where the log has no lidar."""
    if frame.depth is None:
        return {}
    near = near_returns(frame.depth)
    ground = torch.ones_like(near)
    for mask in (frame.sky, frame.ego):
        ground = ground if mask is None else ground & ~mask
    return {"near_lidar": near & ground, "beyond_lidar": ~near & ground}


class _Measured:
    """One pair of images with what all regions share: the render in 8 bits, and maps of similarity and distance."""

    def __init__(self, rgb: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], lpips: Mapping[str, Lpips]) -> None:
        self.rgb, self.truth, self.rgb8 = rgb, truth, metrics.rounded(rgb)
        shorter = min(rgb.shape[:2])
        self.windows = {"ssim_uniform7": ssim.UNIFORM7}
        if shorter >= GAUSS_WINDOW:
            self.windows["ssim_gauss11"] = ssim.GAUSS11
        self.maps = {name: ssim.ssim_map(rgb, truth, window) for name, window in self.windows.items()}
        self.layers = {name: one.layer_maps(rgb, truth) for name, one in lpips.items() if shorter >= LPIPS_SIDES[name]}

    def whole(self) -> RegionQuality:
        error = metrics.mse(self.rgb, self.truth)
        return RegionQuality(
            pixels=self.rgb.shape[0] * self.rgb.shape[1],
            mse=error,
            psnr=metrics.psnr_of_mse(error),
            psnr8=metrics.psnr(self.rgb8, self.truth),
            **{name: ssim.ssim_of_map(self.maps[name], window) for name, window in self.windows.items()},
            **{name: lpips_of_layers(layers) for name, layers in self.layers.items()},
        )

    def within(self, region: str, mask: Bool[Tensor, "h w"]) -> RegionQuality:
        error = metrics.masked_mse(self.rgb, self.truth, mask)
        if error is None:
            return RegionQuality(0, None, None, None)
        values: dict[str, float | None] = {"mse": error, "psnr": metrics.psnr_of_mse(error)}
        values["psnr8"] = metrics.masked_psnr(self.rgb8, self.truth, mask)
        values |= {name: ssim.masked_ssim_of_map(one, mask) for name, one in self.maps.items()}
        values |= {name: masked_lpips_of_layers(layers, mask) for name, layers in self.layers.items()}
        return RegionQuality(int(mask.sum()), **{name: values.get(name) for name in quantities_of(region)})
