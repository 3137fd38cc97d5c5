"""Saturation: pixels that are cut off at white, by flare, lamps or a wrong exposure. Reported, not simulated."""

from dataclasses import dataclass

from sparsestreet.evidence.light import measured_light
from sparsestreet.scene.effects.effect import Finding
from sparsestreet.scene.effects.reported import NOT_SIMULATED, ReportedSettings
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True, kw_only=True)
class SaturationSettings(ReportedSettings):
    """Called for where many pixels of the street are white."""

    threshold: float = 0.02
    """Share of the pixels that are not sky."""

    def detect(self, data: TrainingData) -> Finding:
        found = measured_light(data.frames)
        return Finding(
            called_for=found.clipped >= self.threshold,
            reason=(
                f"pixels of {found.images} images are cut off at white; frame {found.worst_frame} has most of them, "
                f"{100 * found.worst:.1f} %, as where the sun shines into the lens"
            ),
            value=found.clipped,
            unit="of the street's pixels",
            threshold=self.threshold,
            noise=found.clipped_error,
            missing=NOT_SIMULATED,
        )
