"""A learning rate over a run; every node assigns one to each of its parameters."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True)
class LearningRate:
    """A rate that decays log-linearly from ``initial`` to ``final``. Raises ValueError for rates or start out of range.

    >>> rate = LearningRate(initial=0.01, final=0.0001, start=0.1)
    >>> rate.factor(0.0), round(rate.factor(0.5), 3), round(rate.factor(1.0), 3)
    (0.0, 0.1, 0.01)
    """

    initial: float
    final: float | None = None
    """Rate at the end of the run; None: the rate is constant."""
    scale_by_scene_radius: bool = False
    """Whether the rate is multiplied by the scene radius (meters), as 3DGS does for the means."""
    start: float = 0.0
    """Fraction of the run before which the rate is 0; the decay still counts from the start of the run."""

    def __post_init__(self) -> None:
        if not self.initial > 0 or (self.final is not None and not self.final > 0):
            raise ValueError(f"learning rates must be > 0, got initial={self.initial} and final={self.final}")
        if not 0 <= self.start <= 1:
            raise ValueError(f"a learning rate starts at a fraction of the run in [0, 1], got start={self.start}")

    @classmethod
    def of(cls, said: "LearningRate | Mapping[str, Any]") -> "LearningRate":
        """A rate as it is, or one from a mapping of its fields. Raises ValueError for anything else."""
        if isinstance(said, LearningRate):
            return said
        names = [field.name for field in fields(cls)]
        if not (isinstance(said, Mapping) and {"initial"} <= said.keys() <= set(names)):
            raise ValueError(f"a learning rate has initial, and may have {', '.join(names[1:])}; got {said}")
        return cls(**said)

    def factor(self, progress: float) -> float:
        """Return the multiplier of the initial rate at a progress in [0, 1]."""
        if progress < self.start:
            return 0.0
        if self.final is None:
            return 1.0
        return (self.final / self.initial) ** min(max(progress, 0.0), 1.0)


Rates = Mapping[str, LearningRate | Mapping[str, Any]]
"""Name -> rate, or a mapping of the rate's fields."""


def rates_of(said: Rates) -> dict[str, LearningRate]:
    """Return every rate as a ``LearningRate``. Raises ValueError for anything else.

    >>> rates_of({"means": {"initial": 0.01}})["means"].initial
    0.01
    """
    return {name: LearningRate.of(rate) for name, rate in said.items()}


def usual_rates() -> dict[str, LearningRate]:
    """Return the rates of conf/schedule/short.yaml: for Gaussians twice those of 3DGS (Kerbl et al. 2023).

    >>> usual_rates()["opacity_logits"].initial
    0.1
    """
    return {
        "means": LearningRate(3.2e-4, 3.2e-6, scale_by_scene_radius=True),
        "log_scales": LearningRate(1e-2),
        "quaternions": LearningRate(2e-3),
        "opacity_logits": LearningRate(1e-1),
        "sh_dc": LearningRate(5e-3),
        "sh_rest": LearningRate(2.5e-4),
        "mask_features": LearningRate(1e-3),
        "mask": LearningRate(1.6e-3),
        "mask_logits": LearningRate(3e-2),
    }


def usual_background_rates() -> dict[str, LearningRate]:
    """Return ``usual_rates`` with that of a background's scales (docs/length.md).

    >>> usual_background_rates()["log_scales"].initial
    0.02
    """
    return usual_rates() | {"log_scales": LearningRate(2e-2)}


def usual_track_rates() -> dict[str, LearningRate]:
    """Return ``usual_rates`` and those of conf/node/rigid.yaml for the corrections of boxes.

    >>> usual_track_rates()["rotation_deltas"].final
    5e-06
    """
    deltas = {"rotation_deltas": LearningRate(1e-5, 5e-6), "translation_deltas": LearningRate(5e-4, 1e-4)}
    return usual_rates() | deltas


def matching_rate(name: str, rates: Rates, where: str) -> LearningRate:
    """Return the rate of a parameter by its dotted name.

    A key matches if the name contains its words in a row. It can be a column (``means`` in ``rows.means``) or a module
    (``mlp`` in ``mlp.0.weight``). The longest key wins. Raises ValueError, naming ``where`` to add one, for a parameter
    without a rate.

    >>> rates = {"means": LearningRate(0.01), "mlp": LearningRate(0.1)}
    >>> matching_rate("rows.means", rates, where="node.background.learning_rates").initial
    0.01
    """
    found = [key for key in rates if f".{key}." in f".{name}."]
    if not found:
        raise ValueError(f"parameter {name!r} has no learning rate: add one to {where}, which has {_listed(rates)}")
    return LearningRate.of(rates[max(found, key=len)])


def _listed(keys: Iterable[str]) -> str:
    return ", ".join(keys) or "none"
