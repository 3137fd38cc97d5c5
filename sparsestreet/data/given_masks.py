"""Masks that somebody made for a data set: in each folder of a kind a folder a camera, in it the images' stems."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from sparsestreet.data.images import check_mask, image_size, read_mask
from sparsestreet.data.problems import Problem, attempt, fault, missing_files
from sparsestreet.data.undistortion import Undistortion

_KINDS = ("sky", "human", "vehicle", "ego")


@dataclass(frozen=True)
class GivenMasks:
    """PNGs ``KIND/CAMERA/STEM.png``, white where the kind is, at the size of the recorded images.

    A camera without a folder has no masks of the kind; one with a folder has them for all of its images.
    """

    root: Path

    @property
    def kinds(self) -> frozenset[str]:
        return frozenset(kind for kind in _KINDS if (self.root / kind).is_dir())

    def paths(self, camera: str, stem: str) -> dict[str, Path]:
        """Kind -> the file of an image, for the kinds that its camera has."""
        folders = {kind: self.root / kind / camera for kind in _KINDS}
        return {kind: folder / f"{stem}.png" for kind, folder in folders.items() if folder.is_dir()}

    def read(
        self,
        camera: str,
        stem: str,
        *,
        recorded_size: tuple[int, int],
        size: tuple[int, int],
        undistortion: Undistortion | None = None,
    ) -> dict[str, Bool[Tensor, "h w"]]:
        """Kind -> mask at ``size``, both (width, height), without the lens if told.

        Raises LogError for a file that is missing or broken.
        """
        masks = {}
        for kind, path in self.paths(camera, stem).items():
            if not path.is_file():
                raise fault(path, "the mask is missing", "write a mask for every image, or remove the camera's folder")
            if (found := image_size(path)) != recorded_size:
                message = "the mask is {}x{}, the camera's images are {}x{}".format(*found, *recorded_size)
                raise fault(path, message, "write masks at the size of the recorded images")
            masks[kind] = read_mask(path, size, sky=kind == "sky", undistortion=undistortion)
        return masks

    def check(self, images: Iterable[tuple[str, str]]) -> list[Problem]:
        """What is missing for some images, each a camera and a stem."""
        if not self.kinds:
            message = f"it holds none of the folders {', '.join(_KINDS)}"
            return [Problem(self.root, message, "name the folder that holds them (data.log.masks), or null")]
        return missing_files(path for camera, stem in images for path in self.paths(camera, stem).values())

    def check_pixels(self, images: Iterable[tuple[str, str]], size: tuple[int, int]) -> list[Problem]:
        """What is wrong with those that are there, all of which are decoded; ``size``: (width, height) as recorded."""
        problems: list[Problem] = []
        for path in filter(Path.is_file, (path for each in images for path in self.paths(*each).values())):
            attempt(problems, partial(check_mask, path, size, decode=True))
        return problems
