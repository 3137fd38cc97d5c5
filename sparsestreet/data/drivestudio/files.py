"""The files of the part of a folder that is read."""

from dataclasses import replace
from pathlib import Path

from sparsestreet.data.drivestudio.layout import MASK_KINDS, Layout
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.problems import LogError, missing_files


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
    for kind in MASK_KINDS:
        paths = [layout.mask(kind, frame, camera) for frame, camera in layout.images]
        files += [path for path in paths if path is not None]
    return files
