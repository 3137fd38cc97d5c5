"""What is read of a folder when a frame or a sweep is asked for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.drivestudio.layout import MASK_KINDS, Layout
from sparsestreet.data.drivestudio.poses import read_intrinsics, world_from_camera
from sparsestreet.data.drivestudio.sweeps import read_sweep
from sparsestreet.data.images import image_size, read_image, read_mask
from sparsestreet.data.lazy import RecentlyUsed
from sparsestreet.data.lidar import color_points, depth_image, seen_points
from sparsestreet.data.problems import LogError, Problem
from sparsestreet.geometry.distortion import largest_shift
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import Camera, Frame, Sweep, View

T = TypeVar("T")


@dataclass(frozen=True)
class Mount:
    """What is the same in all images of a camera."""

    number: int
    """As the folder counts it."""
    index: int
    """As the log counts it."""
    intrinsics: Float[Tensor, "3 3"]
    size: tuple[int, int]
    distortion: Float[Tensor, "5"] | None
    """Of a lens that is simulated."""
    note: str | None
    """What becomes of the lens, where the camera has one."""


def read_mount(layout: Layout, index: int, number: int, width: int | None, min_lens_shift: float | None) -> Mount:
    """Size after scaling, and intrinsics scaled per axis with it: pixel centers lie at +0.5, so cx and cy scale too.

    Raises ValueError for a width that the images do not have.
    """
    full_width, full_height = image_size(layout.image(layout.frames[0], number))
    if width is not None and not 0 < width <= full_width:
        raise ValueError(f"width must be within 1 to {full_width}, the images of camera {number}, got {width}")
    size = (full_width, full_height) if width is None else (width, max(1, round(full_height * width / full_width)))
    scale = torch.tensor([size[0] / full_width, size[1] / full_height, 1.0], dtype=torch.float64)
    intrinsics, distortion = read_intrinsics(layout.intrinsics(number))
    intrinsics = scale[:, None] * intrinsics
    simulated, note = False, None
    if distortion.any():
        simulated, note = _choice(number, largest_shift(intrinsics, distortion, *size), min_lens_shift)
    return Mount(number, index, intrinsics.float(), size, distortion.float() if simulated else None, note)


def _choice(number: int, shift: float, min_lens_shift: float | None) -> tuple[bool, str]:
    """Whether a lens that moves pixels by up to ``shift`` is simulated, and a sentence that says so."""
    lens = f"camera {number}: its lens"
    if min_lens_shift is None:
        return False, f"{lens}, which moves pixels by up to {shift:.3g}, is ignored, as asked"
    if shift < min_lens_shift:
        return False, f"{lens} moves pixels by at most {shift:.3g} and is left out (data.log.min_lens_shift)"
    return True, f"{lens} moves pixels by up to {shift:.3g} and is simulated"


class Source:
    """The folder of a log in the re-centered world: poses are read at once, images and points when asked for."""

    def __init__(
        self,
        layout: Layout,
        mounts: Sequence[Mount],
        origin: Float64[Tensor, "3"],
        cache_bytes: int,
        check: Callable[[], list[Problem]],
    ) -> None:
        """``check`` finds everything that is wrong with the folder; it is asked once something is."""
        self._layout = layout
        self._mounts = mounts
        self._origin = origin
        self._check = check
        self.views = [self._read_view(index, mount) for index in range(len(layout.frames)) for mount in mounts]
        self._frames = RecentlyUsed(self._read_frame, _count_bytes, cache_bytes)
        # The cameras of one instant are mostly asked for in a row, and look at the same points.
        self._points = RecentlyUsed(self._read_points, lambda points: 1, 1)

    def frame(self, view: View) -> Frame:
        """The view with its pixels. Raises LogError, with all problems of the folder, where a file is broken."""
        return self._explained(lambda: self._frames((view.frame_index, view.camera_index)))

    def sweep(self, index: int) -> Sweep:
        """The points of an instant in the colors of its images. Raises LogError as ``frame`` does."""
        return self._explained(lambda: self._read_sweep(index))

    def gray_sweep(self, index: int) -> Sweep:
        """The same without colors, for which no image need be decoded. Raises LogError as ``frame`` does."""
        return self._explained(lambda: self._read_gray_sweep(index))

    def _explained(self, read: Callable[[], T]) -> T:
        try:
            return read()
        except LogError as error:
            raise LogError(self._check() or error.problems) from error

    def _read_view(self, index: int, mount: Mount) -> View:
        pose = world_from_camera(self._layout, self._layout.frames[index], mount.number)
        pose[:3, 3] -= self._origin
        camera = Camera(inverse(pose).float(), mount.intrinsics, *mount.size, mount.distortion)
        return View(camera, index / max(len(self._layout.frames) - 1, 1), index, mount.index)

    def _read_frame(self, key: tuple[int, int]) -> Frame:
        index, camera_index = key
        view, mount = self._views_at(index)[camera_index], self._mounts[camera_index]
        number = self._layout.frames[index]
        mask_paths = {kind: self._layout.mask(kind, number, mount.number) for kind in MASK_KINDS}
        masks = {
            kind: None if path is None else read_mask(path, mount.size, sky=kind == "sky")
            for kind, path in mask_paths.items()
        }
        ego = self._layout.ego_mask(mount.number)
        return Frame(
            view.camera,
            view.time,
            index,
            camera_index,
            image=read_image(self._layout.image(number, mount.number), mount.size),
            sky=masks["sky"],
            human=masks["human"],
            vehicle=masks["vehicle"],
            depth=depth_image(self._points(index), view.camera) if self._layout.has_lidar else None,
            ego=None if ego is None else read_mask(ego, mount.size, sky=False),
        )

    def _read_points(self, index: int) -> Float[Tensor, "n 3"]:
        return (read_sweep(self._layout, self._layout.frames[index]) - self._origin).float()

    def _read_sweep(self, index: int) -> Sweep:
        frames = [self._frames((index, mount.index)) for mount in self._mounts]
        points = self._points(index)
        return Sweep(index, points, *color_points(points, [(frame.camera, frame.image) for frame in frames]))

    def _read_gray_sweep(self, index: int) -> Sweep:
        points = self._points(index)
        seen = seen_points(points, [view.camera for view in self._views_at(index)])
        return Sweep(index, points, torch.full_like(points, 0.5), seen)

    def _views_at(self, index: int) -> list[View]:
        return self.views[index * len(self._mounts) : (index + 1) * len(self._mounts)]


def _count_bytes(frame: Frame) -> int:
    pixels = (frame.image, frame.sky, frame.human, frame.vehicle, frame.depth, frame.ego)
    return sum(part.nbytes for part in pixels if part is not None)
