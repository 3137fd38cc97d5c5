"""Contents of a folder in DriveStudio's layout: poses, images, boxes and sweeps, and which files they are in."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.drivestudio.layout import FOLDER_KINDS, NAME_IT, Layout, read_numbers
from sparsestreet.data.images import (
    image_notes,
    image_size,
    joined,
    read_image,
    read_mask,
    read_transparent,
)
from sparsestreet.data.json_tree import unique
from sparsestreet.data.lidar import check_points, empty_notes, returned, unit_intensities
from sparsestreet.data.poses import AHEAD_FROM_OPENCV, check_rigid, recentered
from sparsestreet.data.problems import LogError, Problem, fault, missing_files
from sparsestreet.data.reader import LogFiles
from sparsestreet.data.rig import RigCamera, rig_camera
from sparsestreet.data.timestamps import LogClock, read_stamps
from sparsestreet.data.tracks import checked_track
from sparsestreet.geometry.cameras import transform_points
from sparsestreet.types import Frame, Track, View


def required_files(layout: Layout) -> list[Path]:
    """Files that must be there, those of optional kinds only where the kind's folder is."""
    files = [layout.intrinsics(camera) for camera in layout.cameras] + pose_files(layout)
    files += _pixel_files(layout)
    if layout.has_lidar:
        files += [layout.sweep(frame) for frame in layout.frames]
    files += [layout.bodies] if layout.has_bodies else []
    return files + ([layout.instances] if layout.has_instances else [])


def complete(layout: Layout) -> Layout:
    """Return the layout without frames that lack a file. Raises LogError where every frame does."""
    common = set(required_files(replace(layout, frames=())))
    frames = [
        frame
        for frame in layout.frames
        if all(path.is_file() for path in required_files(replace(layout, frames=(frame,))) if path not in common)
    ]
    if not frames:
        raise LogError(missing_files(required_files(layout)))
    return replace(layout, frames=frames, absent=len(layout.frames) - len(frames))


def pose_files(layout: Layout) -> list[Path]:
    """Every pose that is read, once, among them the front camera's that the world is re-centered on."""
    cameras = sorted({*layout.cameras, layout.front})
    poses = [layout.extrinsics(frame, camera) for frame in layout.frames for camera in cameras]
    if layout.flavor.mounted or layout.has_lidar:
        poses += [layout.sweep_pose(frame) for frame in layout.frames]
    return list(dict.fromkeys(poses))


def hashed_files(layout: Layout) -> LogFiles:
    """What of the chosen frames and cameras tells the log, lidar and bodies too where they are there and not wanted.

    A run without lidar is then seen to be of the same log as one with it.
    """
    layout = replace(layout, has_lidar=layout.sweep(0).parent.is_dir(), has_bodies=layout.bodies.parent.is_dir())
    described = [*(layout.intrinsics(camera) for camera in layout.cameras), *pose_files(layout)]
    described += [layout.instances, layout.frame_instances, layout.bodies, layout.timestamps]
    described += [layout.image_timestamps(camera) for camera in layout.cameras]
    recorded = _pixel_files(layout) + [path for camera in layout.cameras if (path := layout.ego_mask(camera))]
    if layout.has_lidar:
        recorded += [layout.sweep(frame) for frame in layout.frames]
    return LogFiles(described, recorded)


def _pixel_files(layout: Layout) -> list[Path]:
    """Images, and the masks of the kinds that the log has."""
    files = [layout.image(frame, camera) for frame, camera in layout.images]
    for kind in FOLDER_KINDS:
        paths = [layout.mask(kind, frame, camera) for frame, camera in layout.images]
        files += [path for path in paths if path is not None]
    return files


def read_pose(path: Path) -> Float64[Tensor, "4 4"]:
    """A rigid transform; raises LogError where the file holds anything else."""
    pose = torch.from_numpy(read_numbers(path))
    if pose.shape != (4, 4):
        raise fault(path, f"a pose is a 4x4 matrix, this is {tuple(pose.shape)}", "write four rows of four numbers")
    check_rigid(pose, path, "the matrix")
    return pose


def read_intrinsics(path: Path) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, "5"]]:
    """The camera matrix in pixels of the full image and the distortion k1, k2, p1, p2, k3; raises LogError."""
    numbers = torch.from_numpy(read_numbers(path)).flatten()
    if numbers.shape != (9,):
        message = f"a camera has 9 numbers (fx fy cx cy k1 k2 p1 p2 k3), this file has {numbers.shape[0]}"
        raise fault(path, message, "write them one a line; zeros for a camera without distortion")
    if not torch.isfinite(numbers).all() or not (numbers[:4] > 0).all():
        message = f"fx, fy, cx, cy must be positive pixels, they are {numbers[:4].tolist()}"
        raise fault(path, message, "write the calibration of the full-size images")
    fx, fy, cx, cy = numbers[:4].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64), numbers[4:]


def world_from_camera(layout: Layout, frame: int, camera: int) -> Float64[Tensor, "4 4"]:
    """Pose of a camera (OpenCV axes) in the data set's world; raises LogError."""
    pose = read_pose(layout.extrinsics(frame, camera))
    if layout.flavor.mounted:
        pose = read_pose(layout.sweep_pose(frame)) @ pose
    return pose if layout.flavor.opencv else pose @ AHEAD_FROM_OPENCV


def first_pose(layout: Layout) -> Float64[Tensor, "4 4"]:
    """Pose of the vehicle, if cameras are mounted on it, else of the front camera, in the data set's world.

    It is that of the first frame read. The log is re-centered on its position; the axes are kept.
    """
    first = layout.frames[0]
    return read_pose(layout.sweep_pose(first) if layout.flavor.mounted else layout.extrinsics(first, layout.front))


def read_vehicle(layout: Layout) -> Float64[Tensor, "f 4 4"]:
    """Poses of the vehicle that cameras are mounted on, one a frame of the window, in the data set's world."""
    return torch.stack([read_pose(layout.sweep_pose(frame)) for frame in layout.frames])


def read_clock(layout: Layout) -> LogClock:
    """The times of the frames of the window; raises LogError for stamps that cannot be those of the folder's frames."""
    stamps = _in_window(layout, layout.timestamps) if layout.has_clock else None
    return LogClock(len(layout.frames), stamps, tuple(chain.from_iterable(read_image_stamps(layout).values())))


def read_image_stamps(layout: Layout) -> dict[int, tuple[int, ...]]:
    """Camera number -> stamps of its images in the window, where they are not those of their frames.

    Raises LogError for stamps that cannot be those of the camera's images, and where images have no poses of their own.
    """
    paths = {camera: layout.image_timestamps(camera) for camera in layout.cameras}
    own = {camera: path for camera, path in paths.items() if path.exists()}
    for path in own.values():
        if not layout.has_clock:
            raise fault(path, "there is no timestamps.txt of the frames beside it", "write it, by the same clock")
        if layout.flavor.mounted:
            message = f"images have instants, but no poses of their own (flavor {layout.flavor.name})"
            raise fault(path, message, "write extrinsics/TTT_C.txt, a pose for each image, as the nuScenes flavor has")
    return {camera: _in_window(layout, path) for camera, path in own.items()}


def _in_window(layout: Layout, path: Path) -> tuple[int, ...]:
    stamps = read_stamps(path, layout.num_frames_on_disk)
    return tuple(stamps[frame] for frame in layout.frames)


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
    paths = {kind: layout.mask(kind, number, camera.name) for kind in FOLDER_KINDS}
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


_COLUMNS = ("frame_idx", "obj_to_world", "box_size")


def read_instances(layout: Layout) -> list[Track]:
    """All annotated objects in the data set's world, with the folder's own frame numbers, named by their JSON key.

    The boxes of instances_info.json count; frame_instances.json repeats them and may leave out frames without boxes.
    Raises LogError with every object at fault.
    """
    entries = _read_json(layout.instances)
    tracks, problems = [], []
    for key, entry in entries.items():
        try:
            tracks.append(_read_track(key, entry, layout))
        except LogError as error:
            problems.extend(error.problems)
    if layout.frame_instances.is_file():
        problems.extend(_unknown_instances(layout, set(entries)))
    if problems:
        raise LogError(problems)
    return tracks


def _read_track(key: str, entry: Any, layout: Layout) -> Track:
    path, name = layout.instances, f"object {key}"
    try:
        class_name = str(entry["class_name"])
        columns = [np.array(entry["frame_annotations"][column], dtype=np.float64) for column in _COLUMNS]
    except (KeyError, TypeError, ValueError) as error:
        remedy = f"give it class_name and frame_annotations with the lists {', '.join(_COLUMNS)}"
        raise fault(path, f"{name} cannot be read ({error!r})", remedy) from error
    frames, poses, sizes = columns
    return checked_track(key, class_name, frames, poses, sizes, path=path, num_frames=layout.num_frames_on_disk)


def _unknown_instances(layout: Layout, known: set[str]) -> list[Problem]:
    """Objects that frame_instances.json lists and instances_info.json does not describe."""
    listed = {str(key) for keys in _read_json(layout.frame_instances).values() for key in keys}
    unknown = sorted(listed - known)
    if not unknown:
        return []
    message = f"it lists objects {unknown[:5]} that {layout.instances.name} does not describe"
    return [Problem(layout.frame_instances, message, "write both files from the same annotations")]


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or remove the folder to read the log without boxes")
    try:
        content = json.loads(path.read_text(), object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise fault(path, f"the file is no JSON ({error})", "write it again from the annotations") from error
    if not isinstance(content, dict):
        raise fault(path, f"the file holds a {type(content).__name__}, not an object", "key it by instance or frame")
    return content


_REMEDY = "drop these returns, and make sure that the rows have the flavor's columns"


def check_sweep_size(layout: Layout, frame: int) -> None:
    """Raise LogError unless the file holds whole rows."""
    path, columns = layout.sweep(frame), layout.flavor.columns
    if path.stat().st_size % (4 * columns):
        message = f"{path.stat().st_size} bytes are no whole number of rows of {columns} float32"
        remedy = f"write float32 rows of {columns} columns ({layout.flavor.name} flavor), or {NAME_IT}"
        raise fault(path, message, remedy)


def read_points(
    layout: Layout, origin: Float64[Tensor, "3"], ahead: Sequence[float | int] | None, index: int
) -> Float[Tensor, "n 3"]:
    """Points of a frame of the window in the re-centered world; ``ahead`` and errors as in ``read_sweep``."""
    return (read_sweep(layout, layout.frames[index], ahead) - origin).float()


def read_sweep(layout: Layout, frame: int, ahead: Sequence[float | int] | None = None) -> Float64[Tensor, "n 3"]:
    """Points of one instant in the data set's world, meters; raises LogError for broken rows or a broken pose.

    ``ahead``: of Waymo's points, which lie in the frame of the vehicle, only those with x between these numbers.
    """
    points, some, _ = _returns(layout, frame, ahead)
    return transform_points(read_pose(layout.sweep_pose(frame)), points[some])


def read_intensities(layout: Layout, ahead: Sequence[float | int] | None, index: int) -> Float[Tensor, " n"] | None:
    """Those of the points of ``read_points``; None: the flavor has none that is known."""
    if layout.flavor.intensity is None:
        return None
    _, some, rows = _returns(layout, layout.frames[index], ahead)
    # Waymo's are unbounded, few above 1; other data sets are converted as they were, from 0 to 1 or to 255.
    brightest = 1.0 if layout.flavor.name == "waymo" else None
    return unit_intensities(rows[:, layout.flavor.intensity], brightest)[some]


def _returns(
    layout: Layout, frame: int, ahead: Sequence[float | int] | None
) -> tuple[Float64[Tensor, "m 3"], Bool[Tensor, " m"], np.ndarray]:
    """Points as they are written, which of them count, and all numbers of their rows."""
    points, rays, rows = _read_rows(layout, frame)
    some = returned(points) & returned(rays)
    if ahead is not None and layout.flavor.name == "waymo":
        some &= (points[:, 0] > ahead[0]) & (points[:, 0] < ahead[1])
    return points, some, rows


def sweep_origin(layout: Layout, origin: Float64[Tensor, "3"], index: int) -> Float64[Tensor, "3"] | None:
    """Where the lidar of a frame of the window stood, in the re-centered world.

    Waymo's rows begin there (of several lidars: the median row's); points of nuScenes are in its own frame. None: other
    flavors do not tell.
    """
    frame, flavor = layout.frames[index], layout.flavor.name
    if flavor not in ("waymo", "nuscenes"):
        return None
    stood = torch.zeros(1, 3, dtype=torch.float64)
    if flavor == "waymo":
        points, rays, _ = _read_rows(layout, frame)
        if not len(points):
            return None
        stood = (points - rays).median(dim=0).values[None]
    return transform_points(read_pose(layout.sweep_pose(frame)), stood)[0] - origin


def sweep_notes(layout: Layout) -> list[str]:
    """What is said about points that are no returns."""
    frames = {layout.sweep(frame): frame for frame in layout.frames} if layout.has_lidar else {}
    return empty_notes(lambda path: _read_rows(layout, frames[path])[1], list(frames))


def _read_rows(layout: Layout, frame: int) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"], np.ndarray]:
    """Points as they are written, and seen from the sensor: in a Waymo row the ray's origin comes before its end. Also
    all numbers of the rows."""
    check_sweep_size(layout, frame)
    path = layout.sweep(frame)
    check_regular(path)
    rows = np.fromfile(path, dtype="<f4").reshape(-1, layout.flavor.columns)
    first = layout.flavor.x_column
    points = torch.from_numpy(rows[:, first : first + 3].astype(np.float64))
    check_points(points, path, remedy=_REMEDY)
    rays = points - torch.from_numpy(rows[:, :3].astype(np.float64)) if first else points
    return points, rays, rows
