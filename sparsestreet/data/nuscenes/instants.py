"""Which images, which sweep and which boxes belong to one instant."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median_low
from typing import Literal

from sparsestreet.data.nuscenes.scene import LIDAR, DataFile, SceneFiles

Rate = Literal["keyframes", "all"]
HALF_TURN = 25_000_000
"""Nanoseconds from the middle of a sweep to its stamp, the end of the turn: the lidar turns 20 times a second."""


@dataclass(frozen=True)
class Instants:
    """The instants of a whole scene."""

    stamps: tuple[int, ...]
    """Of each, nanoseconds, increasing."""
    images: Mapping[tuple[int, str], DataFile]
    """(instant, channel) -> image."""
    sweeps: Mapping[int, DataFile]
    """Instant -> sweep."""
    of_samples: Mapping[int, int]
    """Place of a sample -> the instant nearest to it; of two samples with the same instant the nearer one."""
    without_instant: int
    """Images that no instant takes, because it has a nearer one of the same camera."""


def find_instants(scene: SceneFiles, rate: Rate) -> Instants:
    """The samples, or with ``rate="all"`` the images of the front camera."""
    return _keyframes(scene) if rate == "keyframes" else _all_images(scene)


def _keyframes(scene: SceneFiles) -> Instants:
    """A sample is an instant, with the files that it is said to have."""
    found = {(file.sample, name): file for name, files in scene.files.items() for file in files if file.keyframe}
    images = {key: file for key, file in found.items() if key[1] != LIDAR}
    sweeps = {sample: file for (sample, name), file in found.items() if name == LIDAR}
    twins = sum(file.keyframe for files in scene.files.values() for file in files) - len(found)
    return Instants(scene.sample_stamps, images, sweeps, {place: place for place in range(len(scene.samples))}, twins)


def _all_images(scene: SceneFiles) -> Instants:
    """An image of the front camera is an instant; the other cameras fire in turn, each at its own delay.

    Images and samples, less their delay behind the front camera, go to the nearest instant. A sweep goes to the one
    nearest to its middle, when the beam crossed the cameras.
    """
    front = scene.files[scene.cameras[0]]
    stamps = tuple(sorted({file.stamp for file in front}))
    fired = _keyframe_stamps(front)
    images: dict[tuple[int, str], DataFile] = {}
    for camera in scene.cameras:
        files = scene.files[camera]
        taken = _nearest_items(stamps, [file.stamp for file in files], _delay(fired, _keyframe_stamps(files)))
        images |= {(instant, camera): files[item] for instant, item in taken.items()}
    sweeps = scene.files.get(LIDAR, ())
    turned = _nearest_items(stamps, [file.stamp for file in sweeps], HALF_TURN)
    samples = _nearest_items(stamps, scene.sample_stamps, _delay(fired, dict(enumerate(scene.sample_stamps))))
    return Instants(
        stamps,
        images,
        {instant: sweeps[item] for instant, item in turned.items()},
        {sample: instant for instant, sample in samples.items()},
        sum(len(scene.files[camera]) for camera in scene.cameras) - len(images),
    )


def _keyframe_stamps(files: Sequence[DataFile]) -> dict[int, int]:
    """Sample -> the stamp of its file."""
    return {file.sample: file.stamp for file in files if file.keyframe}


def _delay(front: Mapping[int, int], other: Mapping[int, int]) -> int:
    """Nanoseconds that something is later than the front camera: the median of the samples that have both."""
    delays = [stamp - front[sample] for sample, stamp in other.items() if sample in front]
    return median_low(delays) if delays else 0


def _nearest_items(stamps: Sequence[int], items: Sequence[int], delay: int) -> dict[int, int]:
    """Instant -> the nearest of the items that are nearest to it, all ``delay`` earlier than their own stamps."""
    nearest: dict[int, int] = {}
    for item, stamp in enumerate(items):
        instant = _nearest(stamps, stamp - delay)
        held = nearest.get(instant)
        if held is None or abs(stamp - delay - stamps[instant]) < abs(items[held] - delay - stamps[instant]):
            nearest[instant] = item
    return nearest


def _nearest(stamps: Sequence[int], stamp: int) -> int:
    """Place of the nearest of increasing stamps; of two equally near ones the earlier."""
    after = bisect_left(stamps, stamp)
    if after == 0:
        return 0
    if after == len(stamps):
        return after - 1
    return after if stamps[after] - stamp < stamp - stamps[after - 1] else after - 1
