"""Images as they were recorded: where each is, its pixels, and the masks that a data set or somebody else made."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float64, UInt8
from torch import Tensor

from sparsestreet.data.hood import bottom_rows
from sparsestreet.data.images import GivenMasks, image_size, read_image
from sparsestreet.data.problems import fault
from sparsestreet.data.rig import RigCamera
from sparsestreet.types import Shutter


@dataclass(frozen=True)
class RecordedImage:
    """One recorded image."""

    frame: int
    """The instant it belongs to, counted from 0 in the window that is read. A camera has one image an instant."""
    camera: int
    """Place of its camera in the rig."""
    world_from_camera: Float64[Tensor, "4 4"]
    """OpenCV's axes; in the data set's own world, at the middle of the readout."""
    key: Hashable
    """What ``Recording.read_image`` needs to find the pixels: mostly a path."""
    stem: str
    """Its name without folder and ending; a user's own masks are found by it."""
    stamp: int | None = None
    """Nanoseconds on the data set's clock at the middle of exposure and readout; None: the data set has no clock."""
    shutter: Shutter | None = None
    """Its motion while it is read out, where the data set declares a rolling shutter."""
    exposure: float | None = None
    """Seconds that a pixel is exposed, where declared."""

    @property
    def path(self) -> Path | None:
        """The file of its pixels; None: they stand in the file of many."""
        found = getattr(self.key, "path", self.key)
        return Path(found) if isinstance(found, (str, Path)) else None

    @property
    def file(self) -> Path:
        """The same, of an image that is known to have a file of its own."""
        assert self.path is not None
        return self.path


Masks = Mapping[str, Bool[Tensor, "h w"]]


@dataclass(frozen=True)
class Pixels:
    """Decodes images that are files of their own, and their masks, as the cameras of a rig have the pixels."""

    rig: Sequence[RigCamera[str]]
    recorded_sizes: Sequence[tuple[int, int]]
    """(width, height) that each camera's images have."""
    given: GivenMasks
    shipped: Callable[[RecordedImage], Masks] = lambda shot: {}
    """Masks of the data set itself; those that are given replace them kind by kind."""
    said: str = "its calibration is for"
    """Where the sizes are from."""

    def image(self, shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
        """Raise LogError for a broken file, or one of another size than the camera's."""
        camera = self.rig[shot.camera]
        check_size(shot.file, self.recorded_sizes[shot.camera], self.said)
        return read_image(shot.file, camera.size, camera.undistortion)

    def masks(self, shot: RecordedImage) -> dict[str, Bool[Tensor, "h w"]]:
        """Kind -> mask. Raise LogError for a broken file, or one of another size than the camera's images."""
        camera = self.rig[shot.camera]
        return dict(self.shipped(shot)) | self.given.read(
            camera.name,
            shot.stem,
            recorded_size=self.recorded_sizes[shot.camera],
            size=camera.size,
            undistortion=camera.undistortion,
        )


def check_size(path: Path, size: tuple[int, int], said: str = Pixels.said) -> None:
    """Raise LogError unless the header has this (width, height), which is ``said`` somewhere; nothing is decoded."""
    found = image_size(path)
    if found != size:
        message = "the image is {}x{}, {} {}x{}".format(*found, said, *size)
        raise fault(path, message, "copy images and calibration from the same archive")


def lowest_rows(rig: Sequence[RigCamera[str]], rows: Mapping[str, tuple[int, int]]) -> Callable[[RecordedImage], Masks]:
    """Return masks of the recording car, for ``Pixels.shipped``.

    ``rows``: camera -> how many of its lowest rows show the car, and of how many.
    """
    masks = {one.index: {"ego": bottom_rows(one.size, *rows[one.name])} for one in rig if one.name in rows}
    return lambda shot: masks.get(shot.camera, {})
