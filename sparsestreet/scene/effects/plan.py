"""Which effects a log calls for: a decision for each, with its reason, before anything is built."""

from collections.abc import Mapping
from dataclasses import dataclass

from sparsestreet.records.run import EffectDecision
from sparsestreet.scene.effects.effect import EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True)
class PlannedEffect:
    """One effect, what was found out about it, and what follows."""

    name: str
    settings: EffectSettings
    finding: Finding
    on: bool

    @property
    def only_found(self) -> bool:
        """Whether the log calls for it, and something is missing for a scene to have it."""
        return self.finding.called_for and not self.on

    def _reason(self) -> str:
        if not self.only_found:
            return self.finding.reason
        switched = f" (effects.{self.name}=auto simulates it)" if self.settings.when == "off" else ""
        return f"found, not simulated{switched}: {self.finding.reason}"

    def decision(self, data: TrainingData, rows: int) -> EffectDecision:
        """The effect as records have it, for a scene of ``rows`` Gaussians."""
        finding, cost = self.finding, self.settings.cost(data)
        return EffectDecision(
            name=self.name,
            on=self.on,
            source="forced" if self.settings.when != "auto" else "declared" if finding.declared else "measured",
            reason=self._reason(),
            value=finding.value,
            unit=finding.unit,
            threshold=finding.threshold,
            noise=finding.noise,
            numbers=cost.numbers,
            ms=cost.ms(_pixels(data), rows),
            gain=finding.gain,
        )


@dataclass(frozen=True)
class EffectPlan:
    """All effects that a configuration knows, in the order in which they act on an image."""

    effects: tuple[PlannedEffect, ...]

    def decisions(self, data: TrainingData, rows: int) -> tuple[EffectDecision, ...]:
        """What ``run.json`` holds, for a scene of ``rows`` Gaussians."""
        return tuple(effect.decision(data, rows) for effect in self.effects)


def plan_effects(effects: Mapping[str, EffectSettings], data: TrainingData) -> EffectPlan:
    """Ask every effect whether the log calls for it. Trains nothing, builds nothing, and takes seconds.

    Raises ValueError, saying what is missing, for an effect that is forced on and that the log cannot support.
    """
    return EffectPlan(tuple(_planned(name, settings, data) for name, settings in effects.items()))


_OFF = Finding(called_for=False, reason="the configuration says so")
"""What is off is not looked for, unless it is off by default."""


def _planned(name: str, settings: EffectSettings, data: TrainingData) -> PlannedEffect:
    when = settings.when
    finding = _OFF if when == "off" and not settings.found_when_off else settings.detect(data)
    if when == "on" and finding.missing is not None:
        raise ValueError(f"effects.{name} is on, but {finding.reason}: {finding.missing}, or say auto")
    on = when == "on" or (when == "auto" and finding.called_for and not finding.missing)
    return PlannedEffect(name, settings, finding, on)


def _pixels(data: TrainingData) -> int:
    """Of the largest image that is trained on."""
    return max(view.camera.width * view.camera.height for view in data.views)
