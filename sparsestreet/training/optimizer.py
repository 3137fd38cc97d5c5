"""One Adam over groups of parameters, each with its own learning rate and decay."""

import math
from dataclasses import asdict, dataclass
from typing import Literal

import torch

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.learning_rate import LearningRate
from sparsestreet.training.adam import RowAdam, VisibleAdam


@dataclass(frozen=True)
class OptimizerSettings:
    """Adam for the whole scene; the rates are those that nodes and effects say of their parameters."""

    eps: float = 1e-15
    """Adam's epsilon. At torch's default of 1e-8 mask logits whose only gradient is lambda_n / K never move."""
    visible_only: bool = False
    """True: rows whose gradient is exactly zero keep their values and moments (VisibleAdam)."""
    largest_radius: float | None = 40.0
    """Meters: rates that are scaled by the scene's radius count no more of it. Detail does not grow with the length of
    a drive. None: all of it (3DGS, DriveStudio)."""

    relative_length: float = 1.0
    """K: training images and steps, relative to those that the rates were set on. A Gaussian is seen as often in all,
    but in 1/K of the steps. Adam divides by the root of a mean over all steps, also over those that do not see it. So
    the Gaussian moves further each time, sqrt(K) times or more, and its moments forget more until the next. Rates /
    sqrt(K) and betas to the power of 1/K undo both: the rule of several images, for 1/K images (docs/length.md). Not
    with ``visible_only``, where moments rest with their Gaussian."""

    batch_rule: Literal["sqrt", "none"] = "sqrt"
    """Of steps that take n > 1 images. sqrt (Grendel-GS, Zhao et al. 2024): rates times sqrt(n) and Adam's betas to the
    power of n, so that moments remember as many images and n images move a parameter about as far as n steps of one;
    none: as for one image."""

    def __post_init__(self) -> None:
        if self.largest_radius is not None and not self.largest_radius > 0:
            raise ValueError(f"largest_radius must be > 0 m, got {self.largest_radius}: null for no limit")
        if not self.relative_length > 0:
            raise ValueError(f"relative_length must be > 0, got {self.relative_length}: 1 for rates as they are")

    def build(self, scene: SceneGraph, radius: float, images: int = 1) -> torch.optim.Optimizer:
        """Adam with one group per rate, in which parameters of all nodes are stepped together.

        ``radius`` is the scene's, meters; ``images`` are those of a step.

        Raises ValueError for a parameter without a rate.
        """
        rates, groups = scene.learning_rates(), {}
        counted = images if self.batch_rule == "sqrt" else 1
        counted = counted if self.visible_only else counted / self.relative_length
        factor, betas = math.sqrt(counted), (0.9**counted, 0.999**counted)
        radius = radius if self.largest_radius is None else min(radius, self.largest_radius)
        for name, parameter in scene.named_parameters():
            rate = rates[name]
            initial = rate.initial * (radius if rate.scale_by_scene_radius else 1.0) * factor
            # Plain values: a checkpoint keeps them.
            empty = {"params": [], "lr": initial, "initial_lr": initial, "rate": asdict(rate)}
            groups.setdefault(rate, empty)["params"].append(parameter)
        if self.visible_only:
            return VisibleAdam(groups.values(), betas=betas, eps=self.eps)
        return RowAdam(groups.values(), betas=betas, eps=self.eps)


def set_rates(optimizer: torch.optim.Optimizer, progress: float) -> None:
    """Give every group its rate at a progress in [0, 1].

    Without state, rather than by a scheduler: groups come and go with the masks, and a resumed run needs nothing but
    its step.
    """
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * LearningRate(**group["rate"]).factor(progress)
