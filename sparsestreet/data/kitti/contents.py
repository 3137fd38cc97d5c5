"""Pixels and points of a recording: read at the size that its calibration has, and checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jaxtyping import Bool, UInt8
from torch import Tensor

from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import image_size, read_image
from sparsestreet.data.problems import Problem, attempt, fault
from sparsestreet.data.recording import RecordedImage, Recording
from sparsestreet.data.rig import RigCamera

Masks = Mapping[str, Bool[Tensor, "h w"]]


@dataclass(frozen=True)
class Pixels:
    """Decodes the images of a rig, whose files are the keys of the shots."""

    rig: tuple[RigCamera[str], ...]
    recorded_sizes: tuple[tuple[int, int], ...]
    """(width, height) that each camera's calibration has."""
    given: GivenMasks | None = None
    shipped: Callable[[RecordedImage], Masks] | None = None
    """Masks of the data set itself; those that are given replace them kind by kind."""

    def image(self, shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
        path, camera = Path(str(shot.key)), self.rig[shot.camera]
        check_size(path, self.recorded_sizes[shot.camera])
        return read_image(path, camera.size, camera.undistortion)

    def masks(self, shot: RecordedImage) -> Masks:
        camera = self.rig[shot.camera]
        masks = {} if self.shipped is None else dict(self.shipped(shot))
        if self.given is not None:
            masks |= self.given.read(
                camera.name,
                shot.stem,
                recorded_size=self.recorded_sizes[shot.camera],
                size=camera.size,
                undistortion=camera.undistortion,
            )
        return masks


def check_size(path: Path, size: tuple[int, int]) -> None:
    """Raises LogError unless the header says this (width, height); nothing is decoded."""
    found = image_size(path)
    if found != size:
        message = "the image is {}x{}, its calibration is for {}x{}".format(*found, *size)
        raise fault(path, message, "copy images and calibration from the same archive")


def check_recording(recording: Recording) -> list[Problem]:
    """What is wrong with images, masks and points, all of which are decoded, one at a time."""
    problems: list[Problem] = []
    for shot in recording.shots:
        attempt(problems, partial(recording.read_image, shot))
        attempt(problems, partial(recording.read_masks, shot))
    for sweep in (recording.sweeps or {}).values():
        attempt(problems, sweep.read)
    return problems
