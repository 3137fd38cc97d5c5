"""One Adam over named parameter groups, each with its own learning rate and decay."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from sparsestreet.training.visible_adam import VisibleAdam


@dataclass(frozen=True)
class LearningRate:
    """A learning rate that decays log-linearly from ``initial`` to ``final`` over the run."""

    initial: float
    final: float | None = None
    """None: constant."""
    scale_by_scene_radius: bool = False
    """True: multiplied by the scene radius (meters), as 3DGS does for the means."""

    def factor(self, progress: float) -> float:
        """Multiplier of the initial rate at a progress in [0, 1]."""
        if self.final is None:
            return 1.0
        return (self.final / self.initial) ** min(max(progress, 0.0), 1.0)


@dataclass(frozen=True)
class OptimizerSettings:
    """Which rate each parameter of the scene takes.

    A key is the end of a parameter's dotted name (``means``, ``rigid.rows.means``, ``sky.texels``); the longest key
    that matches wins. A parameter without a key is an error.
    """

    rates: Mapping[str, LearningRate]
    eps: float = 1e-15
    """Adam's epsilon. At torch's default of 1e-8 mask logits whose only gradient is lambda_n / K never move."""
    visible_only: bool = False
    """True: rows whose gradient is exactly zero keep their values and moments (VisibleAdam)."""

    def rate_of(self, name: str) -> LearningRate:
        keys = [key for key in self.rates if name == key or name.endswith(f".{key}")]
        if not keys:
            raise ValueError(
                f"parameter {name!r} has no learning rate: add one to optimization.rates {list(self.rates)}"
            )
        return self.rates[max(keys, key=len)]

    def build(self, scene: nn.Module, radius: float) -> torch.optim.Optimizer:
        """Adam with one group per parameter, named like it; ``radius`` is the scene's, meters."""
        groups = []
        for name, parameter in scene.named_parameters():
            rate = self.rate_of(name)
            initial = rate.initial * (radius if rate.scale_by_scene_radius else 1.0)
            groups.append({"params": [parameter], "lr": initial, "initial_lr": initial, "name": name})
        if self.visible_only:
            return VisibleAdam(groups, eps=self.eps)
        return torch.optim.Adam(groups, eps=self.eps, fused=True)

    def set_rates(self, optimizer: torch.optim.Optimizer, progress: float) -> None:
        """Give every group its rate at a progress in [0, 1].

        By name and without state, rather than by a scheduler: groups come and go with the masks, and a resumed run
        needs nothing but its step.
        """
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * self.rate_of(group["name"]).factor(progress)
