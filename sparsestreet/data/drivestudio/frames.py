"""Views from poses and calibrations, and frames from the files of images and masks."""

from collections.abc import Iterator, Sequence

from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.clock import LogClock
from sparsestreet.data.drivestudio.layout import MASK_KINDS, Layout
from sparsestreet.data.drivestudio.poses import read_image_stamps, read_intrinsics, world_from_camera
from sparsestreet.data.images import (
    image_notes,
    image_size,
    joined,
    read_image,
    read_mask,
    read_transparent,
)
from sparsestreet.data.poses import recentered
from sparsestreet.data.rig import RigCamera, rig_camera
from sparsestreet.types import Frame, View


def read_rig(layout: Layout, width: int | None, undistort: bool = False) -> list[RigCamera[int]]:
    """The chosen cameras; raises as ``rig_camera``."""
    rig = []
    for index, number in enumerate(layout.cameras):
        intrinsics, distortion = read_intrinsics(layout.intrinsics(number))
        rig.append(
            rig_camera(
                number,
                index,
                intrinsics=intrinsics,
                distortion=distortion,
                recorded_size=image_size(layout.image(layout.frames[0], number)),
                width=width,
                undistort=undistort,
            )
        )
    return rig


def read_views(
    layout: Layout, rig: Sequence[RigCamera[int]], origin: Float64[Tensor, "3"], clock: LogClock
) -> list[View]:
    """Every view of the window, in the re-centered world; raises LogError for a broken pose."""
    views, stamps = [], read_image_stamps(layout)
    for index, frame in enumerate(layout.frames):
        for mounted in rig:
            camera = mounted.at(recentered(world_from_camera(layout, frame, mounted.name), origin))
            own = stamps.get(mounted.name)
            views.append(clock.view(camera, index, mounted.index, None if own is None else own[index]))
    return views


def read_frame(layout: Layout, rig: Sequence[RigCamera[int]], view: View) -> Frame:
    """The view with its image and masks, decoded; raises LogError where a file is broken."""
    frame_index, camera_index = view.indices
    number, camera = layout.frames[frame_index], rig[camera_index]
    lens = camera.undistortion
    paths = {kind: layout.mask(kind, number, camera.name) for kind in MASK_KINDS}
    masks = {
        kind: None if path is None else read_mask(path, camera.size, sky=kind == "sky", undistortion=lens)
        for kind, path in paths.items()
    }
    path, mask = layout.image(number, camera.name), layout.ego_mask(camera.name)
    ego = None if mask is None else read_mask(mask, camera.size, sky=False, undistortion=lens)
    return Frame.of(
        view,
        image=read_image(path, camera.size, lens),
        ego=camera.not_of_the_street(joined(ego, read_transparent(path, camera.size, lens))),
        **masks,
    )


def pixel_notes(layout: Layout) -> Iterator[str]:
    """What is done with unusual pixels of images, by their headers."""
    for camera in layout.cameras:
        yield from image_notes(camera, (layout.image(frame, camera) for frame in layout.frames))
