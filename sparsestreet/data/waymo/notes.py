"""What a user should know about how a segment was read."""

from collections.abc import Sequence

from sparsestreet.data.recording import RecordedImage
from sparsestreet.data.waymo.segment import Segment

_ORDERS = {
    0: "not declared, taken as all pixels at once",
    1: "rows from the top",
    2: "columns from the left",
    3: "rows from below",
    4: "columns from the right",
    5: "all pixels at once",
}


def segment_notes(
    segment: Segment,
    frames: range,
    cameras: Sequence[str],
    shots: Sequence[RecordedImage],
    num_labelled: int,
) -> tuple[str, ...]:
    """One sentence each: the shutter's direction, labels made by hand, and images and sweeps that are missing."""
    notes = [*segment.notes, *_shutters(segment, cameras)]
    if num_labelled:
        notes.append(
            f"{num_labelled} of {len(shots)} images have masks of sky, people and vehicles, which Waymo had drawn by "
            "hand; the others have none"
        )
    lacking = len(frames) * len(cameras) - len(shots)
    if lacking:
        notes.append(
            f"{lacking} of {len(frames) * len(cameras)} images are not in the files: their cameras are left out"
        )
    swept = sum(map(segment.has_returns, frames))
    if 0 < swept < len(frames):
        notes.append(f"{len(frames) - swept} of {len(frames)} frames have no range images: they have no points")
    return tuple(notes)


def _shutters(segment: Segment, cameras: Sequence[str]) -> list[str]:
    found: dict[int, list[str]] = {}
    for name in cameras:
        found.setdefault(segment.cameras[name].direction, []).append(name)
    return [f"cameras {', '.join(names)} are read out so: {_ORDERS[direction]}" for direction, names in found.items()]
