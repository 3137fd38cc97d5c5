"""What of a log DriveStudio's layout cannot hold."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import torch

from sparsestreet.data.drivestudio.annotations import (
    ROUNDING,
    boxes_at_frames,
    delay_of_boxes,
    object_keys,
    written_tracks,
)
from sparsestreet.data.drivestudio.classes import class_in
from sparsestreet.data.drivestudio.placement import CAMERAS, Placement, dataset_from_camera
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks
from sparsestreet.data.stamps import frame_stamps

_MOVED = 1e-4
"""Meters, and radians: what float32 poses and mounts are off by is less."""
_SIZES = {"waymo": (*[(1920, 1280)] * 3, *[(1920, 866)] * 2), "nuscenes": [(1600, 900)] * 6}
"""Width and height by DriveStudio's number of the camera, which its loaders do not ask the images for."""


def losses_of(log: DrivingLog, where: Placement) -> tuple[str, ...]:
    """Return what becomes of the log, one sentence each, with numbers."""
    parts: tuple[Callable[[DrivingLog, Placement], Iterator[str]], ...] = (
        _cameras, _images, _shutters, _sweeps, _masks, _boxes, _objects, _others
    )  # fmt: skip
    return tuple(sentence for part in parts for sentence in part(log, where))


def _cameras(log: DrivingLog, where: Placement) -> Iterator[str]:
    numbers = tuple(map(str, where.cameras))
    if log.camera_names and log.camera_names != numbers:
        names = ", ".join(log.camera_names)
        yield f"names of cameras are lost ({log.num_cameras}): {names} become {', '.join(numbers)}"
    exposed = sorted({view.camera.exposure for view in log.views} - {0.0})
    if exposed:
        yield f"exposure times are lost ({exposed[0] * 1e3:.3g} to {exposed[-1] * 1e3:.3g} ms)"


def _images(log: DrivingLog, where: Placement) -> Iterator[str]:
    """Where poses, and when images were taken."""
    if where.mounts is None:
        if log.vehicle is not None:
            yield "the path of the vehicle is lost: the flavor nuscenes has poses of cameras"
        return
    if log.vehicle is not None and log.vehicle.stamps not in (None, frame_stamps(log)):
        yield (f"{len(log.vehicle.poses)} poses of the vehicle become {log.num_frames}, one at the stamp of each frame")
    own = torch.stack([dataset_from_camera(log, view) for view in log.views])
    apart = (own - where.world_from_camera)[:, :3].abs()
    moved, turned = float((own - where.world_from_camera)[:, :3, 3].norm(dim=1).max()), float(apart[..., :3].max())
    if max(moved, turned) > _MOVED:
        yield (
            "poses of images are lost: the flavor waymo has one of the vehicle a frame, in which cameras are rigid; "
            f"images move by up to {moved:.2g} m, and turn by up to {turned:.2g} rad"
        )
    stamps = frame_stamps(log)
    late = [abs(view.stamp - stamps[view.indices[0]]) for view in log.views if view.stamp is not None and stamps]
    if any(late):
        yield f"stamps of images are lost: they become those of their frames, up to {max(late) / 1e6:.3g} ms away"


def _shutters(log: DrivingLog, where: Placement) -> Iterator[str]:
    rolling = [view for view in log.views if view.camera.shutter is not None]
    if rolling:
        shutters = [view.camera.shutter for view in rolling if view.camera.shutter is not None]
        moved = max(float(shutter.translation.norm()) for shutter in shutters)
        turned = max(float(shutter.rotation.norm()) for shutter in shutters)
        cameras = ", ".join(map(str, sorted({where.cameras[view.indices[1]] for view in rolling})))
        yield (
            f"rolling shutters are lost (cameras {cameras}): while an image is read out, its camera moves by up to "
            f"{moved:.2g} m and turns by up to {turned:.2g} rad"
        )


def _sweeps(log: DrivingLog, where: Placement) -> Iterator[str]:
    if absent := without_sweep(log):
        yield f"{len(absent)} frames without a sweep get an empty one, the first of them frame {absent[0]}"


def without_sweep(log: DrivingLog) -> list[int]:
    """Frames that have none, in a log with sweeps."""
    return sorted(set(range(log.num_frames)) - set(log.sweeps.indices)) if len(log.sweeps) else []


def _masks(log: DrivingLog, where: Placement) -> Iterator[str]:
    found = find_masks(log.frames)
    for kind, (frame, camera) in found.lacking.items():
        # A note says where the log has no such mask at all (absence_notes).
        if not any(note.startswith(f"no {kind} masks") for note in log.notes):
            yield (
                f"{kind} masks are lost: there must be one for each of the {len(log.views)} images, and that of frame "
                f"{frame}, camera {where.cameras[camera]} has none"
            )
    if found.changing_ego:
        cameras = ", ".join(str(where.cameras[camera]) for camera in found.changing_ego)
        yield f"masks of the recording car are lost (cameras {cameras}): there is one a camera, and theirs change"


def _boxes(log: DrivingLog, where: Placement) -> Iterator[str]:
    tracks = written_tracks(log, where.flavor.name)
    late = {track.name: delay for track in tracks if (delay := delay_of_boxes(log, track)) > ROUNDING}
    if not late:
        return
    shifts = [
        boxes_at_frames(log, track)[:, :3, 3] - (log.dataset_from_world @ track.world_from_object)[:, :3, 3]
        for track in tracks
        if track.name in late
    ]
    longest = float(torch.cat(shifts).norm(dim=-1).max())
    yield (
        f"boxes are up to {max(late.values()) / 1e6:.1f} ms from the stamps of their frames (objects: {len(late)}), "
        f"and moved there, by up to {longest:.2g} m"
    )


def _objects(log: DrivingLog, where: Placement) -> Iterator[str]:
    flavor = where.flavor.name
    keys = object_keys(written_tracks(log, flavor))
    if renamed := [name for name, key in keys.items() if name != key]:
        yield f"names of objects are lost ({len(renamed)}): they are the ids in instances_info.json"
    classes = sorted(Counter(track.class_name for track in log.tracks).items())
    names = [(name, class_in(flavor, name), count) for name, count in classes]
    if other := [f"{name} is {known} ({count})" for name, known, count in names if known and known != name]:
        yield f"classes get names that DriveStudio knows in its flavor {flavor} (objects): {', '.join(other)}"
    if unknown := [f"{name} ({count})" for name, known, count in names if known is None]:
        yield (
            f"objects are left out whose classes DriveStudio has no name for, in its flavor {flavor}: "
            f"{', '.join(unknown)}"
        )


def _others(log: DrivingLog, where: Placement) -> Iterator[str]:
    if log.sparse_points is not None:
        yield f"{len(log.sparse_points()):,} sparse points are lost"
    if log.truth is not None:
        yield "what cameras beside the recorded path would see, which this street knows, is lost"


def unread_by_drivestudio(log: DrivingLog, where: Placement, stand_ins: Sequence[int]) -> tuple[str, ...]:
    """Return what DriveStudio's own loaders need a change for, one sentence each; ours read the folder as it is.

    ``stand_ins``: cameras that have poses of the log's first one.
    """
    return (*_unknown_cameras(log, where), *_absent_parts(log, where, stand_ins))


def _unknown_cameras(log: DrivingLog, where: Placement) -> Iterator[str]:
    sizes, flavor = _SIZES[where.flavor.name], where.flavor.name
    if unknown := [str(camera) for camera in where.cameras if camera >= len(sizes)]:
        yield f"DriveStudio's {flavor} has {len(CAMERAS[flavor])} cameras: it reads none of {', '.join(unknown)}"
    seen = {where.cameras[view.indices[1]]: (view.camera.width, view.camera.height) for view in log.views}
    other = [
        f"{camera} has {w}x{h}, not {sizes[camera][0]}x{sizes[camera][1]}"
        for camera, (w, h) in seen.items()
        if camera < len(sizes) and (w, h) != sizes[camera]
    ]
    if other:
        yield (
            f"DriveStudio takes sizes of images from datasets/dataset_meta.py, and intrinsics with them: camera "
            f"{', '.join(other)}; write these sizes there"
        )


def _absent_parts(log: DrivingLog, where: Placement, stand_ins: Sequence[int]) -> Iterator[str]:
    masks, flavor = find_masks(log.frames), where.flavor.name
    tracks = written_tracks(log, flavor)
    absent = [
        *(["lidar, without which it does not start"] if not len(log.sweeps) else []),
        *(["boxes (load_objects=false)"] if not tracks else []),
        *(["bodies (load_smpl=false)"] if all(track.body is None for track in tracks) else []),
        *(["sky masks (load_sky_mask=false)"] if "sky" not in masks.everywhere else []),
        *(["human and vehicle masks (load_dynamic_mask=false)"] if len({*masks.everywhere} - {"sky"}) < 2 else []),
    ]
    if absent:
        yield f"DriveStudio asks for what is not there, unless data.pixel_source says so: {', '.join(absent)}"
    if flavor == "waymo" and (empty := without_sweep(log)):
        yield f"DriveStudio does not open empty sweeps: leave out frames {', '.join(map(str, empty[:5]))}"
    if masks.ego:
        yield f"DriveStudio looks for masks of the recording car in data/ego_masks/{flavor}: copy those of ego_masks"
    if stand_ins:
        cameras = ", ".join(map(str, stand_ins))
        yield f"DriveStudio reads poses of cameras {cameras} too, which the log lacks: they are those of its first one"
