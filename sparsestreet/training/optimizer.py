"""One Adam over named parameter groups, each with its own learning rate and decay."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR


@dataclass(frozen=True)
class Rate:
    """A learning rate that decays log-linearly from ``initial`` to ``final`` over the run."""

    initial: float
    final: float | None = None
    """None: constant."""
    in_scene_units: bool = False
    """True: multiplied by the scene radius (metres), as 3DGS does for the means."""

    def factor(self, progress: float) -> float:
        """Multiplier of the initial rate at a progress in [0, 1]."""
        if self.final is None:
            return 1.0
        return (self.final / self.initial) ** min(max(progress, 0.0), 1.0)


@dataclass(frozen=True)
class Optimization:
    """Which rate each parameter of the scene takes.

    A key is the end of a parameter's dotted name (``means``, ``rigid.rows.means``, ``sky.texels``); the longest key
    that matches wins. A parameter without a key, and a key without a parameter name to match in any scene, are errors
    of configuration; the former is raised here.
    """

    rates: Mapping[str, Rate]
    eps: float = 1e-15
    """Adam's epsilon. At torch's default of 1e-8 mask logits whose only gradient is lambda_n / K never move."""

    def rate_of(self, name: str) -> Rate:
        keys = [key for key in self.rates if name == key or name.endswith(f".{key}")]
        if not keys:
            raise ValueError(
                f"parameter {name!r} has no learning rate: add one to optimization.rates {list(self.rates)}"
            )
        return self.rates[max(keys, key=len)]

    def build(self, scene: nn.Module, radius: float, max_steps: int) -> tuple[torch.optim.Adam, LambdaLR]:
        """Adam with one group per parameter (name, rate) and the scheduler that decays them per step."""
        groups, factors = [], []
        for name, parameter in scene.named_parameters():
            rate = self.rate_of(name)
            scale = radius if rate.in_scene_units else 1.0
            groups.append({"params": [parameter], "lr": rate.initial * scale, "name": name})
            factors.append(lambda step, rate=rate: rate.factor(step / max(max_steps, 1)))
        optimizer = torch.optim.Adam(groups, eps=self.eps, fused=True)
        return optimizer, LambdaLR(optimizer, factors)
