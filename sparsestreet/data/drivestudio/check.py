"""The schema check: everything that is wrong with a log, at once."""

from functools import partial
from pathlib import Path

import torch

from sparsestreet.data.drivestudio.bodies import with_bodies
from sparsestreet.data.drivestudio.files import pose_files, required_files
from sparsestreet.data.drivestudio.instances import read_instances
from sparsestreet.data.drivestudio.layout import MASK_KINDS, Layout
from sparsestreet.data.drivestudio.poses import read_clock, read_intrinsics, read_pose
from sparsestreet.data.drivestudio.sweeps import check_sweep_size, read_sweep
from sparsestreet.data.extent import check_extent
from sparsestreet.data.images import check_camera_images, image_size
from sparsestreet.data.problems import Problem, attempt, missing_files
from sparsestreet.data.rig import check_lens


def check_layout(layout: Layout, *, contents: bool) -> list[Problem]:
    """Every problem of the frames and cameras that are read; an empty list means that reading will succeed.

    ``contents=False`` is quick: it trusts lidar points of the right size, and images that are not cut short.
    """
    return [
        *missing_files(required_files(layout)),
        *_check_cameras(layout),
        *_check_poses(layout),
        *_check_clock(layout),
        *_check_images(layout, contents),
        *_check_sweeps(layout, contents),
    ]


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
    intrinsics, distortion = read_intrinsics(layout.intrinsics(camera))
    if distortion.any():
        size = image_size(layout.image(layout.frames[0], camera))
        check_lens(layout.intrinsics(camera), intrinsics, distortion, size)


def _check_poses(layout: Layout) -> list[Problem]:
    """Poses, boxes and bodies, and whether all of them are within one scene."""
    problems: list[Problem] = []
    placed: list[tuple[Path, torch.Tensor]] = []
    for path in filter(Path.is_file, pose_files(layout)):
        pose = attempt(problems, partial(read_pose, path))
        if pose is not None:
            placed.append((path, pose[:3, 3]))
    if layout.flavor.mounted:  # there the extrinsics are relative to the vehicle
        placed = [(path, position) for path, position in placed if path.parent.name == "ego_pose"]
    if layout.instances.is_file():
        tracks = attempt(problems, partial(read_instances, layout)) or []
        placed += [(layout.instances, position) for track in tracks for position in track.world_from_object[:, :3, 3]]
        if layout.bodies.is_file() and tracks:
            attempt(problems, partial(with_bodies, tracks, layout))
    return problems + check_extent(placed)


def _check_images(layout: Layout, contents: bool) -> list[Problem]:
    problems: list[Problem] = []
    for camera in layout.cameras:
        images = [layout.image(frame, camera) for frame in layout.frames]
        masks = [layout.mask(kind, frame, camera) for kind in MASK_KINDS for frame in layout.frames]
        masks = [path for path in (*masks, layout.ego_mask(camera)) if path is not None]
        problems += check_camera_images(camera, images, masks, decode=contents)
    return problems


def _check_clock(layout: Layout) -> list[Problem]:
    problems: list[Problem] = []
    attempt(problems, partial(read_clock, layout))
    return problems


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
