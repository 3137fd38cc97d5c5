"""Dirt on a lens: spots that no scene has. Nothing is learned from their pixels, as from those of a hood."""

from dataclasses import dataclass

from sparsestreet.data.hood import LEAST_DRIVE
from sparsestreet.scene.effects.effect import Finding
from sparsestreet.scene.effects.reported import ReportedSettings
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True, kw_only=True)
class DirtSettings(ReportedSettings):
    """Called for where dark spots stay in a camera's images while the street passes.

    The log's frames have them in ``Frame.ego`` then (``StreetData``); the scene has no part of it.
    """

    min_share: float = 0.005
    """Of an image's pixels."""

    def detect(self, data: TrainingData) -> Finding:
        spots, log = data.log.dirt, data.log
        if not spots:
            return Finding(
                called_for=False,
                reason=f"no camera of {log.name} moves by {LEAST_DRIVE:g} m, so what never changes may be the street",
                unit="of an image",
                threshold=self.min_share,
                missing="read a longer drive, or give masks of the spots (data.log.masks)",
            )
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
