"""The masks of all images of a log, in the folders that readers take them from (``GivenMasks``)."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from sparsestreet.atomic import atomic_file
from sparsestreet.data.images import image_size, mask_png, read_image, read_mask
from sparsestreet.data.reader import LogReader
from sparsestreet.data.recording import RecordedReader, Recording
from sparsestreet.segmentation.classes import KINDS
from sparsestreet.segmentation.model import Segmenter

RECORD = "masks.json"
"""Beside the folders of masks: what they were made with."""
FORMAT = 1

Show = Callable[[Iterable[int], int, str], Iterable[int]]


@dataclass(frozen=True)
class LogImages:
    """The images of a log as they were recorded, counted from 0, and the kinds of masks that they get."""

    recording: Recording
    kinds: Sequence[str]

    @staticmethod
    def of(reader: LogReader, kinds: Sequence[str]) -> "LogImages":
        """Return the images that a reader reads.

        Raises LogError as it does, and ValueError where it takes no folder of masks.
        """
        if not isinstance(reader, RecordedReader):
            remedy = "make masks of the log as it was published, and data convert takes them by data.log.masks=DIR"
            raise ValueError(f"{type(reader).__name__} takes no folder of masks: {remedy}")
        # Without masks that are there already: they may be too few as yet.
        return LogImages(replace(reader, width=None, masks=None).recording(), kinds)

    @property
    def name(self) -> str:
        """The log's."""
        return self.recording.name

    def __len__(self) -> int:
        return len(self.recording.shots)

    def image_name(self, place: int) -> tuple[str, str]:
        """Return the camera of an image, and its stem."""
        shot = self.recording.shots[place]
        return str(self.recording.rig[shot.camera].name), shot.stem

    def image(self, place: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return an image with the lens that it was recorded through. Raises LogError for a file that is broken."""
        shot = self.recording.shots[place]
        if self.recording.rig[shot.camera].undistortion is None:
            return self.recording.read_image(shot).numpy()
        return read_image(shot.file, image_size(shot.file)).numpy()

    def paths(self, place: int, folder: Path) -> dict[str, Path]:
        """Return kind -> file of the mask of an image."""
        camera, stem = self.image_name(place)
        return {kind: folder / kind / camera / f"{stem}.png" for kind in self.kinds}

    def masks(self, place: int, folder: Path) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Return kind -> mask as it was written. Raises LogError for a file that is broken."""
        paths = self.paths(place, folder)
        return {kind: read_mask(path, image_size(path), sky=True).numpy() for kind, path in paths.items()}


@dataclass(frozen=True)
class WrittenMasks:
    """What became of the images of a log."""

    made: int
    """Images that were segmented."""
    found: int
    """Images whose masks were there already."""
    shares: dict[str, float]
    """Kind -> its share of the pixels of those that were segmented."""


def write_masks(
    log: LogImages, segmenter: Segmenter, folder: Path, show: Show = lambda places, total, what: places
) -> WrittenMasks:
    """Write the masks of every image that lacks one, file by file, so that the same call goes on where it was.

    Args:
        log: whose images are segmented.
        segmenter: tells the pixels of each kind.
        folder: of masks of this log by this segmenter, which other images may have in it too.
        show: passes on the places of images, their number and their name, and shows the progress.

    Raises ValueError where the folder has masks of another log, segmenter or version; then nothing was written. Raises
    LogError for an image that cannot be read, and OSError where nothing can be written.
    """
    _take(folder, _record(log, segmenter))
    files = [log.paths(place, folder) for place in range(len(log))]
    wanted = [place for place, paths in enumerate(files) if not all(map(Path.is_file, paths.values()))]
    total, covered = 0, dict.fromkeys(log.kinds, 0)
    for place in show(wanted, len(wanted), "images"):
        for kind, mask in segmenter(log.image(place)).items():
            covered[kind] += int(mask.sum())
            total += mask.size
            with atomic_file(files[place][kind]) as file:
                file.write_bytes(mask_png(mask))
    shares = {kind: len(covered) * count / max(total, 1) for kind, count in covered.items()}
    return WrittenMasks(len(wanted), len(log) - len(wanted), shares)


def _take(folder: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a folder without masks. Raises ValueError where its masks are others."""
    path, remedy = folder / RECORD, "remove it, or name another folder with to=..."
    there = [kind for kind in KINDS if any((folder / kind).rglob("*.png"))]
    if not there:
        with atomic_file(path) as file:
            file.write_text(json.dumps(record, indent=1) + "\n")
        return
    if not path.is_file():
        raise ValueError(f"{folder / there[0]} is there, and no {RECORD} says by which segmenter: {remedy}")
    try:
        found = json.loads(path.read_bytes())
        changed = [key for key in {**record, **found} if found.get(key) != record.get(key)]
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no record of masks ({error}): {remedy}") from error
    if changed:
        raise ValueError(f"{folder} has other masks, which differ in {', '.join(changed)}: {remedy}")


def _record(log: LogImages, segmenter: Segmenter) -> dict[str, Any]:
    """Return what decides about every pixel, as JSON has it."""
    content = {
        "format": FORMAT,
        "version": version("sparsestreet"),
        "log": log.name,
        "model": segmenter.digest(),
        "classes": {"count": segmenter.classes.count, "kinds": segmenter.classes.kinds},
        **asdict(segmenter.preparation),
    }
    return json.loads(json.dumps(content))
