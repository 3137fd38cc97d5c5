"""Which effects a scene has and why, as ``run.json`` says it."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class EffectDecision:
    """One effect that was asked for its reasons before training."""

    name: str
    on: bool
    source: str
    """Who decided: "declared" by the log's files, "measured" on its images, points or boxes, "forced" by the
    configuration."""
    reason: str
    """One sentence, without a full stop."""
    value: float | None
    """What was declared, measured or counted; None: nothing."""
    unit: str
    """Of value, threshold and noise."""
    threshold: float | None
    """Value from which the effect is called for."""
    noise: float | None
    """Standard error of the value; None: unknown."""
    numbers: int
    """Predicted count of stored float32 numbers, if it is on."""
    ms: float
    """Predicted milliseconds of a frame, if it is on."""
    gain: float | None
    """Predicted gain in PSNR, dB; None: no prediction."""
