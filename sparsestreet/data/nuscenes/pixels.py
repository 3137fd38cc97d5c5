"""Images and masks of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, UInt8
from torch import Tensor

from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import image_size, read_image
from sparsestreet.data.nuscenes.cameras import ego_mask
from sparsestreet.data.problems import fault
from sparsestreet.data.recording import RecordedImage
from sparsestreet.data.rig import RigCamera


@dataclass(frozen=True)
class ScenePixels:
    """Pixels of shots."""

    rig: Sequence[RigCamera[str]]
    recorded_sizes: Sequence[tuple[int, int]]
    """(width, height) of each camera of the rig."""
    scene: str
    """Its name."""
    given: GivenMasks | None

    @property
    def mask_kinds(self) -> frozenset[str]:
        ego = frozenset({"ego"} if any(ego_mask(self.scene, camera) is not None for camera in self.rig) else ())
        return ego if self.given is None else ego | self.given.kinds

    def image(self, shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
        path = Path(str(shot.key))
        check_size(path, self.recorded_sizes[shot.camera])
        return read_image(path, self.rig[shot.camera].size)

    def masks(self, shot: RecordedImage) -> dict[str, Bool[Tensor, "h w"]]:
        """Those that somebody made; the rows of the recording car where they have none of it."""
        camera = self.rig[shot.camera]
        ego = ego_mask(self.scene, camera)
        known = {} if ego is None else {"ego": ego}
        if self.given is None:
            return known
        recorded = self.recorded_sizes[shot.camera]
        return known | self.given.read(camera.name, shot.stem, recorded_size=recorded, size=camera.size)


def check_size(path: Path, size: tuple[int, int]) -> None:
    """Raises LogError unless the image has the size that the tables say."""
    found = image_size(path)
    if found != size:
        message = f"the image is {found[0]}x{found[1]}, sample_data.json says {size[0]}x{size[1]}"
        raise fault(path, message, "extract the image again from the data set's archive")
