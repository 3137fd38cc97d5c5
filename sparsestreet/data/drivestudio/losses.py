"""What of a log DriveStudio's layout cannot hold."""

from collections import Counter
from collections.abc import Callable, Iterator

import torch

from sparsestreet.data.drivestudio.annotations import ROUNDING, boxes_at_frames, delay_of_boxes, object_keys
from sparsestreet.data.drivestudio.classes import CLASS_NAMES
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks


def losses_of(log: DrivingLog) -> tuple[str, ...]:
    """One sentence each, with numbers."""
    parts: tuple[Callable[[DrivingLog], Iterator[str]], ...] = (_cameras, _shutters, _masks, _boxes, _names, _others)
    return tuple(sentence for part in parts for sentence in part(log))


def _cameras(log: DrivingLog) -> Iterator[str]:
    numbers = tuple(map(str, range(log.num_cameras)))
    if log.camera_names and log.camera_names != numbers:
        names = ", ".join(log.camera_names)
        yield f"names of cameras are lost ({log.num_cameras}): {names} become {', '.join(numbers)}"


def _shutters(log: DrivingLog) -> Iterator[str]:
    rolling = [view for view in log.views if view.camera.shutter is not None]
    if rolling:
        shutters = [view.camera.shutter for view in rolling if view.camera.shutter is not None]
        moved = max(float(shutter.translation.norm()) for shutter in shutters)
        turned = max(float(shutter.rotation.norm()) for shutter in shutters)
        cameras = ", ".join(map(str, sorted({view.indices[1] for view in rolling})))
        yield (
            f"rolling shutters are lost (cameras {cameras}): while an image is read out, its camera moves by up to "
            f"{moved:.2g} m and turns by up to {turned:.2g} rad"
        )


def _masks(log: DrivingLog) -> Iterator[str]:
    found = find_masks(log.frames)
    for kind, (frame, camera) in found.lacking.items():
        # A note says where the log has no such mask at all (absence_notes).
        if not any(note.startswith(f"no {kind} masks") for note in log.notes):
            yield (
                f"{kind} masks are lost: there must be one for each of the {len(log.views)} images, and that of frame "
                f"{frame}, camera {camera} has none"
            )
    if found.changing_ego:
        cameras = ", ".join(map(str, found.changing_ego))
        yield f"masks of the recording car are lost (cameras {cameras}): there is one a camera, and theirs change"


def _boxes(log: DrivingLog) -> Iterator[str]:
    late = {track.name: delay for track in log.tracks if (delay := delay_of_boxes(log, track)) > ROUNDING}
    if not late:
        return
    shifts = [
        boxes_at_frames(log, track)[:, :3, 3] - (log.dataset_from_world @ track.world_from_object)[:, :3, 3]
        for track in log.tracks
        if track.name in late
    ]
    longest = float(torch.cat(shifts).norm(dim=-1).max())
    yield (
        f"boxes are up to {max(late.values()) / 1e6:.1f} ms from the stamps of their frames (objects: {len(late)}), "
        f"and moved there, by up to {longest:.2g} m"
    )


def _names(log: DrivingLog) -> Iterator[str]:
    keys = object_keys(log)
    if renamed := [name for name, key in keys.items() if name != key]:
        yield f"names of objects are lost ({len(renamed)}): they are the ids in instances_info.json"
    classes = Counter(track.class_name for track in log.tracks if track.class_name in CLASS_NAMES)
    for name, count in sorted(classes.items()):
        yield f"the class {name} becomes {CLASS_NAMES[name]}, which data=drivestudio knows (objects: {count})"


def _others(log: DrivingLog) -> Iterator[str]:
    if log.sparse_points is not None:
        yield f"{len(log.sparse_points()):,} sparse points are lost"
    if log.truth is not None:
        yield "what cameras beside the recorded path would see, which this street knows, is lost"
