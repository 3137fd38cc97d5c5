"""Effects that are looked for and reported, but that no scene simulates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.scene.effects.effect import Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True, kw_only=True)
class ReportedSettings(EffectSettings):
    """The plan reports what is called for, and nothing is built for it."""

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> None:
        return None

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> Effect:
        raise ValueError(f"no scene file holds what is only reported ({type(self).__name__}): train the scene again")
