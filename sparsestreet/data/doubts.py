"""What is probably wrong with a log that can be read: said once, before anything is trained."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sparsestreet.data.contradictions import contradictions
from sparsestreet.data.ego import used_share
from sparsestreet.data.followed import FEWEST, followed
from sparsestreet.data.lazy import Frames, spread
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.notes import counted
from sparsestreet.types import Track

MOST_FRAMES = 36
"""Images that are looked at."""
_LITTLE = 0.05
"""Of all pixels: fewer that losses see are more likely a mask that is turned round."""
_FLAT = 3.0
"""Gray levels, standard deviation over an image, below which it shows nothing."""
_UNLIKE = 1.0
"""Of ``followed``: 0.3 to 0.8 where poses are right, 1.03 and more where the axes of a camera are swapped."""
_SAME = 0.25
"""Of the sides of a box: a second center this near is that of the same object, if its volume is half as large."""


def doubts(log: DrivingLog, frames: Frames | None = None) -> tuple[str, ...]:
    """One sentence each, with what to do; empty for a log without any. Takes a second or two.

    ``frames`` are those that are looked at; None: all of the log.
    """
    frames = log.frames if frames is None else frames
    names = log.camera_names or tuple(map(str, range(log.num_cameras)))
    return (
        *_covered(frames, names),
        *_swapped(frames, log, names),
        *contradictions(log, frames, names),
        *_shared_boxes(log.tracks),
    )


def _covered(frames: Frames, names: Sequence[str]) -> Iterator[str]:
    seen, flat, blind, used = Counter[int](), Counter[int](), Counter[int](), defaultdict[int, float](float)
    for place in spread(len(frames), MOST_FRAMES):
        frame = frames[place]
        camera = frame.indices[1]
        gray = frame.image.float().mean(-1)
        seen[camera] += 1
        share = used_share(frame)
        used[camera] += share
        blind[camera] += not share
        gray = gray if frame.ego is None else gray[~frame.ego]
        flat[camera] += share > 0 and float(gray.std(correction=0)) < _FLAT
    for camera in (camera for camera in sorted(seen) if used[camera] / seen[camera] < _LITTLE):
        yield (
            f"masks or alpha leave {100 * used[camera] / seen[camera]:.2g} % of the pixels of camera {names[camera]} "
            "to be used: check which color of its masks is left out, or leave the camera out (data.log.cameras)"
        )
        blind[camera] = 0
    for camera in sorted(camera for camera in seen if blind[camera]):
        yield (
            f"masks or alpha leave no pixel in {blind[camera]} of {seen[camera]} images of camera {names[camera]}: "
            "check these masks, nothing is learned from such images"
        )
    for camera in sorted(camera for camera in seen if flat[camera]):
        yield (
            f"camera {names[camera]} shows a single gray level in {flat[camera]} of {seen[camera]} images, as if it "
            "were covered: leave it out (data.log.cameras), or mask what it shows (data.log.masks)"
        )


def _swapped(frames: Frames, log: DrivingLog, names: Sequence[str]) -> Iterator[str]:
    for camera, change in followed(frames, log.sweeps, log.tracks).items() if len(log.sweeps) else ():
        if change is None:
            yield (
                f"camera {names[camera]} sees hardly any return of the lidar (below {FEWEST} an image): check the axes "
                "of camera and poses (OpenCV: x right, y down, z ahead), unless it looks where no lidar reaches"
            )
        elif change >= _UNLIKE:
            yield (
                f"returns of the lidar change their gray level {change:.1f} times as much if camera {names[camera]} is "
                "followed along its poses as if it stood still: check the axes of camera and poses (OpenCV: x right, y "
                "down, z ahead) and the stamps, or mask the recording car where the image shows it (data.log.masks)"
            )


def _shared_boxes(tracks: Sequence[Track]) -> Iterator[str]:
    same, inside = Counter[tuple[int, int]](), Counter[tuple[int, int]]()
    present: dict[int, list[tuple[int, Tensor]]] = {}
    for number, track in enumerate(tracks):
        for frame, pose in zip(track.frames.tolist(), track.world_from_object, strict=True):
            present.setdefault(frame, []).append((number, pose))
    for boxes in present.values():
        for large, small, beside in _within(tracks, boxes):
            alike = float(tracks[small].size.prod()) > 0.5 * float(tracks[large].size.prod())
            (same if alike and beside < _SAME else inside)[large, small] += 1
    for (large, small), count in same.items():
        if 2 * count >= len(tracks[small].frames):
            yield (
                f"objects {tracks[large].name} and {tracks[small].name} ({tracks[small].class_name}) have one box in "
                f"{counted(count, 'frame')}: remove one of them, or both are drawn"
            )
    for (large, small), count in inside.items():
        if 2 * count >= len(tracks[small].frames):
            yield (
                f"object {tracks[small].name} ({tracks[small].class_name}) is inside the box of {tracks[large].name} "
                f"({tracks[large].class_name}) in {counted(count, 'frame')}: both start from what is seen there; "
                "remove the one that needs no motion of its own"
            )


def _within(tracks: Sequence[Track], boxes: Sequence[tuple[int, Tensor]]) -> Iterator[tuple[int, int, float]]:
    """Pairs of one frame of which the smaller box has its center in the larger one, and how far beside the middle: the
    largest part of a side."""
    centers = torch.stack([pose[:3, 3] for _, pose in boxes])
    reach = max(float(tracks[number].size.max()) for number, _ in boxes) / 2
    for one, other in torch.nonzero(torch.cdist(centers, centers) <= reach).tolist():
        (large, pose), (small, _) = boxes[one], boxes[other]
        volumes = [(float(tracks[number].size.prod()), -number) for number in (large, small)]
        if one == other or volumes[0] < volumes[1]:
            continue
        offset = pose[:3, :3].T @ (centers[other] - centers[one])
        beside = float((offset.abs() / tracks[large].size).max())
        if beside <= 0.5:
            yield large, small, beside
