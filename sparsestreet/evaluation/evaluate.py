"""Renders against recorded images, one at a time: nothing is kept but numbers, and predictions on disk."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt16
from torch import Tensor

from sparsestreet.atomic import atomic_file
from sparsestreet.data.frame_cache import to_device
from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.data.lidar import near_returns
from sparsestreet.metrics.definitions import quantities_of
from sparsestreet.metrics.image import psnr_of_mse
from sparsestreet.metrics.lpips import Lpips
from sparsestreet.metrics.reported import ImageMetric, errors_by_region, reported_metrics
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.summary import FrameQuality, RegionQuality
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import Frame, View

LEVELS = 65535


class PredictionError(ValueError):
    """A stored prediction that cannot be read; names the file and the remedy."""


@dataclass(frozen=True)
class Predictions:
    """The predictions of some views, one file each."""

    folder: Path

    @classmethod
    def of(cls, run: Path, split: str) -> "Predictions":
        """Those that a run keeps of the views of a split."""
        return cls(run / "predictions" / split)

    def path(self, frame: int, camera: int) -> Path:
        """The file of one view."""
        return self.folder / f"{frame:03d}_{camera}.png"

    def clear(self) -> None:
        """Remove those of an earlier evaluation, perhaps of other views; files of other names stay."""
        for path in self.folder.glob("[0-9]*_[0-9]*.png"):
            path.unlink()

    def write(self, frame: int, camera: int, pixels: UInt16[np.ndarray, "h w 3"]) -> None:
        """Write one, the whole file or nothing. Raises OSError where it cannot be written."""
        path = self.path(frame, camera)
        with atomic_file(path) as temporary:
            # OpenCV's order is BGR. Of 16 bits the lower are noise, which no effort compresses.
            done, data = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if not done:
                raise OSError(f"{path}: an image of shape {pixels.shape} cannot be encoded as PNG")
            temporary.write_bytes(data.tobytes())

    def read(self, frame: int, camera: int) -> UInt16[np.ndarray, "h w 3"]:
        """Read one back. Raises PredictionError for a file that is absent, damaged or no 16-bit RGB PNG."""
        path = self.path(frame, camera)
        if not path.is_file():
            raise PredictionError(f"{path} is not there: evaluate the run, which stores its predictions")
        try:
            pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:  # an empty file, or a header of more pixels than OpenCV reads
            pixels = None
        if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] != 3:
            found = "cannot be decoded" if pixels is None else f"is {pixels.dtype} of shape {pixels.shape}"
            raise PredictionError(f"{path} {found}, a prediction is a 16-bit RGB PNG: evaluate the run again")
        return np.ascontiguousarray(pixels[..., ::-1])


def quantized(image: Float[np.ndarray, "h w 3"]) -> UInt16[np.ndarray, "h w 3"]:
    """Values in [0, 1] as a prediction holds them."""
    return np.round(image.astype(np.float64) * LEVELS).astype(np.uint16)


def restored(pixels: UInt16[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """What a prediction holds as float32 in [0, 1]."""
    return (pixels / LEVELS).astype(np.float32)


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
    metrics = reported_metrics(lpips or {})
    if ranks.size > 1:
        views = frames if isinstance(frames, Frames) else as_frames(tuple(frames))
        yield from _of_all(scene, views, options, predictions, metrics, ranks)
        return
    for frame in frames:
        pixels = quantized(screen_image(scene, frame, options).cpu().numpy())
        if predictions is not None:
            predictions.write(*frame.indices, pixels)
            pixels = predictions.read(*frame.indices)
        yield _quality(pixels, frame, scene.device, metrics)


def _of_all(
    scene: SceneGraph,
    frames: Frames,
    options: RenderOptions,
    predictions: Predictions | None,
    metrics: Mapping[str, ImageMetric],
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
        return (None if predictions is None else pixels), _quality(pixels, frame, scene.device, metrics)

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


def _quality(
    pixels: UInt16[np.ndarray, "h w 3"], frame: Frame, device: torch.device, metrics: Mapping[str, ImageMetric]
) -> FrameQuality:
    return frame_quality(torch.from_numpy(restored(pixels)).to(device), to_device(frame, device), metrics)


@torch.no_grad()
def frame_quality(rgb: Float[Tensor, "h w 3"], frame: Frame, metrics: Mapping[str, ImageMetric]) -> FrameQuality:
    """Compare one clamped render [0, 1] with the frame's image, in full and by region; both on one device."""
    truth, masks = frame.image.float() / 255, region_masks(frame)
    errors = errors_by_region(rgb, truth, masks)
    values = {name: metric.measure(rgb, truth, masks) for name, metric in metrics.items()}
    values["mse"] = errors
    values["psnr"] = {region: None if error is None else psnr_of_mse(error) for region, error in errors.items()}
    height, width = truth.shape[:2]
    pixels = {"full": height * width} | {region: int(mask.sum()) for region, mask in masks.items()}
    regions = {
        region: RegionQuality(count, **{name: values[name][region] for name in quantities_of(region) if name in values})
        for region, count in pixels.items()
    }
    return FrameQuality(*frame.indices, width, height, regions)


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
