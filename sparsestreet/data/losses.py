"""What many layouts have no room for, a sentence each."""

from collections.abc import Callable, Iterator

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.mask_kinds import find_masks
from sparsestreet.data.placed import PlacedLog
from sparsestreet.types import Track


def object_losses(log: DrivingLog, renamed: Callable[[str], str]) -> Iterator[str]:
    """Of objects: classes that a layout calls otherwise, and poses of bodies."""
    classes = {track.class_name for track in log.tracks}
    other = sorted(f"{name} is {renamed(name)}" for name in classes if renamed(name) != name)
    if other:
        yield f"{len(other)} classes get names of the layout: {', '.join(other)}"
    if bodies := sum(track.body is not None for track in log.tracks):
        yield f"the body poses of {bodies} objects are lost"


def point_losses(log: DrivingLog) -> Iterator[str]:
    """Of points that came with the log and were measured by no lidar."""
    if log.sparse_points is not None:
        yield f"{len(log.sparse_points())} points that no lidar measured are lost"


def mask_losses(log: DrivingLog) -> Iterator[str]:
    """Of masks, where a layout has a kind for all images or for none."""
    found = find_masks(log.frames)
    for kind, (frame, camera) in found.lacking.items():
        # A note says where the log has no such mask at all (absence_notes).
        if not any(note.startswith(f"no {kind} masks") for note in log.notes):
            yield f"{kind} masks are lost: not all {len(log.views)} images have one, such as camera {camera} at {frame}"
    if found.changing_ego:
        cameras = ", ".join(map(str, found.changing_ego))
        yield f"masks of the recording car are lost for cameras {cameras}: not all of their images have the same"


def moved_boxes(placed: PlacedLog, stamp_of: Callable[[Track, int], int | None], unit: int = 1) -> Iterator[str]:
    """Of boxes that are written at other instants than their own.

    Args:
        placed: the log.
        stamp_of: the stamp at which a layout has an object's box of a frame; None: it lacks the frame.
        unit: nanoseconds that stamps are rounded to.
    """
    gaps = []
    for track in placed.log.tracks:
        for frame, own in placed.box_stamps(track).items():
            stamp = stamp_of(track, frame)
            if stamp is not None and abs(stamp - own) >= unit:
                gaps.append(abs(stamp - own))
    if gaps:
        most = f"up to {max(gaps) / 1e6:.3g} ms away from their own"
        yield f"{len(gaps)} boxes are moved to the instants of the layout, {most}"
