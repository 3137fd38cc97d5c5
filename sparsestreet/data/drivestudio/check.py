"""The schema check: everything that is wrong with a log, at once."""

from collections import Counter
from functools import partial
from pathlib import Path

import torch

from sparsestreet.data.drivestudio.bodies import with_bodies
from sparsestreet.data.drivestudio.instances import read_instances
from sparsestreet.data.drivestudio.layout import MASK_KINDS, Layout
from sparsestreet.data.drivestudio.poses import read_intrinsics, read_pose
from sparsestreet.data.drivestudio.sweeps import check_sweep_size, read_sweep
from sparsestreet.data.images import check_pixels, image_size
from sparsestreet.data.problems import Problem, attempt, fault, missing_files
from sparsestreet.geometry.distortion import largest_shift

LARGEST_SCENE = 20_000.0
"""Meters. Re-centered coordinates of up to this are exact to 1 mm in float32 (spacing 2^-9 m beyond 16 km, rounded)."""


def check_layout(layout: Layout, *, contents: bool) -> list[Problem]:
    """Every problem of the frames and cameras that are read; an empty list means that reading will succeed.

    ``contents=False`` is quick: it trusts lidar points of the right size, and images that are not cut short.
    """
    return [
        *missing_files(_required(layout)),
        *_check_cameras(layout),
        *_check_poses(layout),
        *_check_images(layout, contents),
        *_check_sweeps(layout, contents),
    ]


def _required(layout: Layout) -> list[Path]:
    """Files that must be there, those of optional kinds only where the kind's folder is."""
    poses = _pose_files(layout)
    files = [layout.intrinsics(camera) for camera in layout.cameras] + poses
    files += [layout.image(frame, camera) for frame, camera in layout.images]
    for kind in MASK_KINDS:
        paths = [layout.mask(kind, frame, camera) for frame, camera in layout.images]
        files += [path for path in paths if path is not None]
    if layout.has_lidar:
        files += [layout.sweep(frame) for frame in layout.frames]
    files += [layout.bodies] if layout.has_bodies else []
    return files + ([layout.instances] if layout.has_instances else [])


def _pose_files(layout: Layout) -> list[Path]:
    """Every pose that is read, once, among them the front camera's that the world is re-centered on."""
    cameras = sorted({*layout.cameras, layout.front})
    poses = [layout.extrinsics(frame, camera) for frame in layout.frames for camera in cameras]
    if layout.waymo or layout.has_lidar:
        poses += [layout.sweep_pose(frame) for frame in layout.frames]
    return list(dict.fromkeys(poses))


def _check_cameras(layout: Layout) -> list[Problem]:
    problems: list[Problem] = []
    for camera in layout.cameras:
        path = layout.intrinsics(camera)
        if path.is_file():
            # A broken image is reported with the images, once.
            found: list[Problem] = []
            attempt(found, partial(_check_camera, layout, camera))
            problems += [problem for problem in found if problem.path == path]
    return problems


def _check_camera(layout: Layout, camera: int) -> None:
    path = layout.intrinsics(camera)
    intrinsics, distortion = read_intrinsics(path)
    if not distortion.any():
        return
    size = image_size(layout.image(layout.frames[0], camera))
    try:
        largest_shift(intrinsics, distortion, *size)
    except ValueError as error:
        message = f"the lens k1 k2 p1 p2 k3 = {distortion.tolist()} images nothing in parts of the image: no inverse"
        remedy = "write the coefficients of the calibration, in OpenCV's order; zeros for images without distortion"
        raise fault(path, message, remedy) from error


def _check_poses(layout: Layout) -> list[Problem]:
    """Poses, boxes and bodies, and whether all of them are within one scene."""
    problems: list[Problem] = []
    placed: list[tuple[Path, torch.Tensor]] = []
    for path in filter(Path.is_file, _pose_files(layout)):
        pose = attempt(problems, partial(read_pose, path))
        if pose is not None:
            placed.append((path, pose[:3, 3]))
    if layout.waymo:  # there the extrinsics are relative to the vehicle
        placed = [(path, position) for path, position in placed if path.parent.name == "ego_pose"]
    if layout.instances.is_file():
        tracks = attempt(problems, partial(read_instances, layout)) or []
        placed += [(layout.instances, position) for track in tracks for position in track.world_from_object[:, :3, 3]]
        if layout.bodies.is_file() and tracks:
            attempt(problems, partial(with_bodies, tracks, layout))
    return problems + _check_extent(placed)


def _check_extent(placed: list[tuple[Path, torch.Tensor]]) -> list[Problem]:
    if not placed:
        return []
    positions = torch.stack([position for _, position in placed])
    extent = float((positions.amax(0) - positions.amin(0)).max())
    if extent <= LARGEST_SCENE:
        return []
    strayed = int((positions - positions.median(0).values).norm(dim=-1).argmax())
    message = f"poses span {extent / 1000:.1f} km, more than the {LARGEST_SCENE / 1000:g} km that float32 can hold"
    remedy = "repair this pose, the farthest from the others, or read fewer frames (data.log.first_frame, .last_frame)"
    return [Problem(placed[strayed][0], message, remedy)]


def _check_images(layout: Layout, contents: bool) -> list[Problem]:
    problems: list[Problem] = []
    for camera in layout.cameras:
        paths = [path for frame in layout.frames if (path := layout.image(frame, camera)).is_file()]
        sizes = {path: attempt(problems, partial(image_size, path)) for path in paths}
        counts = Counter(size for size in sizes.values() if size is not None)
        if not counts:
            continue
        common = counts.most_common(1)[0][0]
        for path, size in sizes.items():
            if size is not None and size != common:
                message = f"the image is {size[0]}x{size[1]}, the others of camera {camera} are {common[0]}x{common[1]}"
                problems.append(Problem(path, message, "write all images of a camera at one size"))
            elif size is not None:
                attempt(problems, partial(check_pixels, path, decode=contents))
        problems += _check_masks(layout, camera, common, contents)
    return problems


def _check_masks(layout: Layout, camera: int, size: tuple[int, int], contents: bool) -> list[Problem]:
    problems: list[Problem] = []
    paths = [layout.mask(kind, frame, camera) for kind in MASK_KINDS for frame in layout.frames]
    for path in (*paths, layout.ego_mask(camera)):
        if path is not None and path.is_file():
            attempt(problems, partial(_check_mask, path, size, contents))
    return problems


def _check_mask(path: Path, size: tuple[int, int], contents: bool) -> None:
    found = image_size(path)
    if found != size:
        message = f"the mask is {found[0]}x{found[1]}, the camera's images are {size[0]}x{size[1]}"
        raise fault(path, message, "write masks at the size of the images")
    check_pixels(path, decode=contents)


def _check_sweeps(layout: Layout, contents: bool) -> list[Problem]:
    problems: list[Problem] = []
    for frame in layout.frames if layout.has_lidar else ():
        if not layout.sweep(frame).is_file():
            continue
        # A broken pose is reported with the poses, once.
        found: list[Problem] = []
        attempt(found, partial(read_sweep if contents else check_sweep_size, layout, frame))
        problems += [problem for problem in found if problem.path == layout.sweep(frame)]
    return problems
