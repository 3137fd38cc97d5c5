"""From a folder in DriveStudio's processed layout to a DrivingLog."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.drivestudio.check import check_layout
from sparsestreet.data.drivestudio.instances import read_instances, window
from sparsestreet.data.drivestudio.layout import Layout, find_layout
from sparsestreet.data.drivestudio.poses import read_intrinsics, world_from_camera, world_origin
from sparsestreet.data.drivestudio.sweeps import read_sweep
from sparsestreet.data.images import image_size, read_image, read_mask
from sparsestreet.data.lidar import color_points, depth_image
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import LogError
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import Camera, Frame, Sweep, Track

_ABSENT = {
    "sky": "no sky masks: nothing but the images tells sky from scene, and there is no sky term in the loss",
    "human": "no human masks: there are no metrics of human pixels",
    "vehicle": "no vehicle masks: there are no metrics of vehicle pixels",
    "lidar": "no lidar: Gaussians start from random points, and there is no depth term in the loss",
    "boxes": "no boxes: nothing is modeled as moving, whatever moves becomes part of the background",
}


@dataclass(frozen=True)
class _Mount:
    """What is the same in all images of a camera."""

    index: int
    number: int
    intrinsics: Float[Tensor, "3 3"]
    size: tuple[int, int]


def read_drivestudio(
    root: Path | str,
    *,
    cameras: Sequence[int] | None = None,
    first_frame: int = 0,
    last_frame: int = -1,
    width: int | None = None,
    ignore_distortion: bool = False,
) -> DrivingLog:
    """Read frames first_frame .. last_frame (included; -1: to the end) of some cameras (None: all).

    Both flavours are recognized by their files. The world keeps the data set's axes and is shifted, in float64, so
    that the vehicle (Waymo) or the front camera (nuScenes) starts at the origin. Frames are counted from the window's
    start, cameras by their place in ``cameras``. ``width`` in pixels scales every image to that width at its own
    aspect, and the intrinsics with it. Time is frame / (frames - 1), 0 in a log of one frame.

    Raises LogError, with every problem found and its remedy, where the folder breaks the layout, and ValueError where
    frames, cameras or a width are asked for that the log cannot give.
    """
    root = Path(root)
    layout = find_layout(root, cameras=cameras, first_frame=first_frame, last_frame=last_frame)
    problems = check_layout(layout, ignore_distortion=ignore_distortion, contents=False)
    if problems:
        raise LogError(problems)
    try:
        return _read(layout, width)
    except LogError as error:
        # Pixels and points are decoded once, here; only when one of them is broken look for all that are.
        everything = check_layout(layout, ignore_distortion=ignore_distortion, contents=True)
        raise LogError(everything or error.problems) from error


def _read(layout: Layout, width: int | None) -> DrivingLog:
    origin = world_origin(layout)
    mounts = [_read_mount(layout, index, number, width) for index, number in enumerate(layout.cameras)]
    frames: list[Frame] = []
    sweeps: list[Sweep] = []
    for index, number in enumerate(layout.frames):
        points = (read_sweep(layout, number) - origin).float() if layout.has_lidar else None
        views = [_read_frame(layout, index, mount, origin, points) for mount in mounts]
        frames += views
        if points is not None:
            sweeps.append(Sweep(index, points, *color_points(points, [(view.camera, view.image) for view in views])))
    dataset_from_world = torch.eye(4, dtype=torch.float64)
    dataset_from_world[:3, 3] = origin
    return DrivingLog(
        name=layout.root.resolve().name,
        frames=tuple(frames),
        sweeps=tuple(sweeps),
        tracks=_read_tracks(layout, origin),
        num_frames=len(layout.frames),
        num_cameras=len(mounts),
        dataset_from_world=dataset_from_world,
        notes=_notes(layout),
    )


def _read_mount(layout: Layout, index: int, number: int, width: int | None) -> _Mount:
    """Size after scaling, and intrinsics scaled per axis with it: pixel centers lie at +0.5, so cx and cy scale too."""
    full_width, full_height = image_size(layout.image(layout.frames[0], number))
    if width is not None and not 0 < width <= full_width:
        raise ValueError(f"width must be within 1 to {full_width}, the images of camera {number}, got {width}")
    size = (full_width, full_height) if width is None else (width, max(1, round(full_height * width / full_width)))
    scale = torch.tensor([size[0] / full_width, size[1] / full_height, 1.0], dtype=torch.float64)
    intrinsics, _ = read_intrinsics(layout.intrinsics(number))
    return _Mount(index, number, (scale[:, None] * intrinsics).float(), size)


def _read_frame(
    layout: Layout, index: int, mount: _Mount, origin: Float64[Tensor, "3"], points: Float[Tensor, "n 3"] | None
) -> Frame:
    number = layout.frames[index]
    pose = world_from_camera(layout, number, mount.number)
    pose[:3, 3] -= origin
    camera = Camera(inverse(pose).float(), mount.intrinsics, *mount.size)
    mask_paths = {kind: layout.mask(kind, number, mount.number) for kind in ("sky", "human", "vehicle")}
    masks = {
        kind: None if path is None else read_mask(path, mount.size, sky=kind == "sky")
        for kind, path in mask_paths.items()
    }
    return Frame(
        frame_index=index,
        time=index / max(len(layout.frames) - 1, 1),
        camera_index=mount.index,
        camera=camera,
        image=read_image(layout.image(number, mount.number), mount.size),
        sky=masks["sky"],
        human=masks["human"],
        vehicle=masks["vehicle"],
        depth=None if points is None else depth_image(points, camera),
    )


def _read_tracks(layout: Layout, origin: Float64[Tensor, "3"]) -> tuple[Track, ...]:
    if not layout.has_instances:
        return ()
    tracks = [window(track, layout.frames, origin) for track in read_instances(layout)]
    return tuple(track for track in tracks if track is not None)


def _notes(layout: Layout) -> tuple[str, ...]:
    present = {kind: layout.mask_folder(kind) is not None for kind in ("sky", "human", "vehicle")}
    present |= {"lidar": layout.has_lidar, "boxes": layout.has_instances}
    notes = [sentence for kind, sentence in _ABSENT.items() if not present[kind]]
    for camera in layout.cameras:
        distortion = read_intrinsics(layout.intrinsics(camera))[1]
        if distortion.any():
            notes.append(f"camera {camera} has lens distortion {distortion.tolist()} that is ignored, as asked")
    return tuple(notes)
