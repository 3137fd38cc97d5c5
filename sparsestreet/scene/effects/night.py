"""Night: images with little light, of which noise is a large part. Reported, not simulated."""

import math
from dataclasses import dataclass

from sparsestreet.evidence.light import measured_light
from sparsestreet.scene.effects.effect import Finding
from sparsestreet.scene.effects.reported import NOT_SIMULATED, ReportedSettings
from sparsestreet.scene.initialize.training_data import TrainingData

_MIDDLE = 118.0
"""Gray level of 255 that an exposure control aims at: 18 % of the light, in sRGB."""


@dataclass(frozen=True, kw_only=True)
class NightSettings(ReportedSettings):
    """Called for where the median image is much darker than a camera would have it."""

    threshold: float = 1.25
    """Stops of the stored values: 1.25 is a mean gray level of 50 of 255."""

    def detect(self, data: TrainingData) -> Finding:
        found = measured_light(data.frames)
        stops = math.log2(_MIDDLE / max(found.level, 0.5))
        return Finding(
            called_for=stops >= self.threshold,
            reason=(
                f"{found.images} images have a mean gray level of {found.level:.0f} of 255, and a noise of "
                f"{found.noise:.1f} levels"
            ),
            value=stops,
            unit="stops below middle gray",
            threshold=self.threshold,
            noise=found.level_error / (max(found.level, 0.5) * math.log(2)),
            missing=NOT_SIMULATED,
        )
