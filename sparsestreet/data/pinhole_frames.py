"""The frames of a log for layouts that know no lens: pixels and masks as pinholes record them, and files of them."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from sparsestreet.data.encoded import jpeg, mask_png, png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks
from sparsestreet.data.undistortion import Undistortion
from sparsestreet.data.writer import LogFile
from sparsestreet.geometry.lenses import BrownConrady, largest_shift
from sparsestreet.types import Camera, Frame

_KINDS = ("sky", "human", "vehicle", "ego")
MASKS = "masks"
"""Folder of the masks of a written log, as readers take it (``data.log.masks``)."""
_HALF = 128


class PinholeFrames:
    """Frames of a log, whose lenses are taken out of images and masks; the last one that was asked for is kept."""

    def __init__(self, log: DrivingLog) -> None:
        """Raises ValueError, naming the camera, where one has different lenses or sizes over time."""
        self._log = log
        self._places = {view.indices: place for place, view in enumerate(log.views)}
        self._undistortions = {
            index: None if camera.distortion is None else _undistortion(camera) for index, camera in rig_of(log).items()
        }
        self._last: tuple[tuple[int, int], Frame] | None = None

    def frame(self, indices: tuple[int, int]) -> Frame:
        """By frame and camera; its camera is a pinhole."""
        if self._last is None or self._last[0] != indices:
            undistortion = self._undistortions[indices[1]]
            frame = self._log.frames[self._places[indices]]
            self._last = indices, frame if undistortion is None else without_lens(frame, undistortion)
        return self._last[1]

    def image(self, indices: tuple[int, int], jpeg_quality: int | None) -> Iterator[bytes]:
        """A JPEG with colors of all pixels; None: a PNG, which has no loss."""
        pixels = self.frame(indices).image.numpy()
        yield png(pixels) if jpeg_quality is None else jpeg(pixels, jpeg_quality)

    def mask_files(self, indices: tuple[int, int], camera: str, stem: str) -> Iterator[LogFile]:
        """A PNG of each kind that all images have, and of the recording car where all of the camera's show the same,
        as ``GivenMasks`` reads them."""
        found, undistortion = find_masks(self._log.frames), self._undistortions[indices[1]]
        blank = undistortion is not None and undistortion.blank is not None
        ego = ("ego",) if indices[1] in found.ego or (blank and indices[1] not in found.changing_ego) else ()
        for kind in (*found.everywhere, *ego):
            yield LogFile(f"{MASKS}/{kind}/{camera}/{stem}.png", partial(self._mask, indices, kind))

    def _mask(self, indices: tuple[int, int], kind: str) -> Iterator[bytes]:
        yield mask_png(getattr(self.frame(indices), kind).numpy())


def rig_of(log: DrivingLog) -> dict[int, Camera]:
    """Index -> the camera of its first image. Raises ValueError, naming the camera, where lens or size change."""
    rig: dict[int, Camera] = {}
    for view in log.views:
        camera, first = view.camera, rig.setdefault(view.indices[1], view.camera)
        same = (first.width, first.height) == (camera.width, camera.height)
        if not (same and torch.equal(first.intrinsics, camera.intrinsics) and _same_lens(first, camera)):
            frame, index = view.indices
            raise ValueError(f"camera {index} has another lens or size at frame {frame}: write a log for each of them")
    return rig


def check_every_image(log: DrivingLog, layout: str) -> None:
    """Raises ValueError, naming the layout, where a camera has no image at some frame."""
    there = {view.indices for view in log.views}
    wanted = [(frame, camera) for frame in range(log.num_frames) for camera in rig_of(log)]
    if absent := [pair for pair in wanted if pair not in there]:
        frame, camera = absent[0]
        raise ValueError(
            f"{layout} has an image of each camera at each frame, but {len(absent)} are absent, the first of camera "
            f"{camera} at frame {frame}: leave such frames or cameras out (data.log.first_frame, .last_frame, .cameras)"
        )


def without_lens(frame: Frame, undistortion: Undistortion) -> Frame:
    """What a pinhole of the same intrinsics would have recorded; pixels that the lens did not record are the own car's,
    which no loss sees."""
    masks = {kind: _straight_mask(undistortion, kind, getattr(frame, kind)) for kind in _KINDS}
    if undistortion.blank is not None:
        masks["ego"] = undistortion.blank if masks["ego"] is None else masks["ego"] | undistortion.blank
    image = torch.from_numpy(undistortion(frame.image.numpy()))
    return replace(frame, camera=replace(frame.camera, distortion=None), image=image, depth=None, **masks)


def lens_losses(log: DrivingLog) -> Iterator[str]:
    """What becomes of lenses and shutters where a layout has no room for them, a sentence each."""
    shifts = [
        largest_shift(camera.intrinsics, camera.distortion, camera.width, camera.height)
        for camera in rig_of(log).values()
        if camera.distortion is not None
    ]
    if shifts:
        moved = f"which move pixels by up to {max(shifts):.3g}"
        yield f"the lenses of {len(shifts)} cameras, {moved}, are taken out of the images"
    rolling = [view.camera.shutter for view in log.views if view.camera.shutter is not None]
    if rolling:
        meters = max(float(shutter.translation.norm()) for shutter in rolling)
        yield (
            f"the rolling shutters of {len(rolling)} images are lost, in whose readout the camera moves by up to "
            f"{meters:.2g} m"
        )


def _straight_mask(
    undistortion: Undistortion, kind: str, mask: Bool[Tensor, "h w"] | None
) -> Bool[Tensor, "h w"] | None:
    """Sky takes the nearest pixel, others every pixel that they touch (``images.read_mask``)."""
    if mask is None:
        return None
    pixels = torch.from_numpy(undistortion(mask.numpy().astype(np.uint8) * 255))
    return pixels >= _HALF if kind == "sky" else pixels > 0


def _same_lens(one: Camera, other: Camera) -> bool:
    if one.distortion is None or other.distortion is None:
        return one.distortion is other.distortion
    return torch.equal(one.distortion, other.distortion)


def _undistortion(camera: Camera) -> Undistortion:
    assert camera.distortion is not None
    intrinsics, size = camera.intrinsics.double(), (camera.width, camera.height)
    return Undistortion.of(BrownConrady.of(intrinsics, camera.distortion.double()), intrinsics, size, size)
