"""Effects that are looked for and reported, but that no scene simulates."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.scene.effects.effect import Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData

NOT_SIMULATED = "nothing simulates it"


@dataclass(frozen=True, kw_only=True)
class ReportedSettings(EffectSettings):
    """``detect`` says that ``NOT_SIMULATED`` is missing: the plan reports what is called for, and leaves it off."""

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> None:
        return None

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> Effect:
        raise ValueError(f"no scene file holds what is only reported ({type(self).__name__}): train the scene again")
