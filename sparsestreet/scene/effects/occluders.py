"""What hides the street from a camera and moves with it: the recording car's hood, and dirt on the lens."""

from dataclasses import dataclass
from functools import partial

from sparsestreet.data.hood import MIN_DRIVE
from sparsestreet.data.log import DrivingLog
from sparsestreet.pictures.images import Marked
from sparsestreet.scene.effects.effect import Finding, PartlessSettings
from sparsestreet.scene.initialize.training_data import TrainingData


def _unknown(log: DrivingLog, min_share: float, what: str) -> Finding:
    """Return what is found in a log whose cameras stand: nothing that can be told from the street."""
    return Finding(
        called_for=False,
        reason=f"no camera of {log.name} moves by {MIN_DRIVE:g} m, so what never changes may be the street",
        unit="of an image",
        threshold=min_share,
        missing=f"read a longer drive, or give masks of {what} (data.log.masks)",
    )


@dataclass(frozen=True, kw_only=True)
class HoodSettings(PartlessSettings):
    """Called for where rows at the bottom of a camera's images never change.

    The log's frames have its pixels in ``Frame.ego`` then (``StreetData``), which losses, seeds, depth and metrics
    leave out; the scene has no part of it.
    """

    min_share: float = 0.02
    """Of an image's pixels."""

    def detect(self, data: TrainingData) -> Finding:
        hoods, log = data.log.hoods, data.log
        if not hoods:
            return _unknown(log, self.min_share, "the car")
        camera, largest = max(hoods.items(), key=lambda item: item[1].share)
        seen = [camera for camera, hood in hoods.items() if hood.share >= self.min_share]
        return Finding(
            called_for=bool(seen),
            reason=(
                f"{len(seen)} of {log.num_cameras} cameras see unchanging rows at the lower border below an unchanging "
                f"edge; camera {camera} sees most of them"
            ),
            value=largest.share,
            unit="of an image",
            threshold=self.min_share,
            noise=largest.error,
            evidence=partial(_shown, data),
            missing=None if largest.share > 0 else "give masks of the car (data.log.masks), if the images show it",
        )


def _shown(data: TrainingData) -> list[Marked]:
    """An image of each camera that moved, with what is found of the car."""
    panels = []
    for camera, hood in data.log.hoods.items():
        own = data.frames.where(lambda view, camera=camera: view.indices[1] == camera)
        found = f"hood, {100 * hood.share:.1f} % of the image" if hood.mask.any() else "no hood"
        panels.append(Marked(f"camera {camera}: {found}", own[len(own) // 2].image.numpy(), hood.mask.numpy()))
    return panels


@dataclass(frozen=True, kw_only=True)
class DirtSettings(PartlessSettings):
    """Called for where dark spots stay in a camera's images while the street passes.

    The log's frames have them in ``Frame.ego`` then (``StreetData``); the scene has no part of it.
    """

    min_share: float = 0.005
    """Of an image's pixels."""

    def detect(self, data: TrainingData) -> Finding:
        spots, log = data.log.dirt, data.log
        if not spots:
            return _unknown(log, self.min_share, "the spots")
        shares = {camera: float(each.mask.float().mean()) for camera, each in spots.items()}
        camera = max(shares, key=shares.__getitem__)
        count = sum(share >= self.min_share for share in shares.values())
        return Finding(
            called_for=count > 0,
            reason=(
                f"{count} of {log.num_cameras} cameras show dark spots that stay while returns of the lidar pass "
                f"behind them; camera {camera} shows most"
            ),
            value=shares[camera],
            unit="of an image",
            threshold=self.min_share,
            noise=spots[camera].error,
            missing=None if shares[camera] > 0 else "give masks of the spots (data.log.masks), if the images show any",
        )
