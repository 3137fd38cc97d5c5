"""Scores Gaussians over all training views and selects which to keep.

``select`` has the interface of the rules, and drops rows by scores but respects the floors of a node and its
instances. ``seen`` adds up what views show of rows, also in training steps. ``rules`` has the paper's rule and ours
(leave one out). ``importance`` has the paper's score, the rules of other papers, and controls that look at no image.
"""

from sparsestreet.pruning.importance import (
    Importance,
    LightGaussianRule,
    MiniSplattingRule,
    OpacityRule,
    RandomRule,
)
from sparsestreet.pruning.rules import ImportanceRule, LeaveOneOutRule
from sparsestreet.pruning.seen import Floors, Gathered, InstanceAreas, regions
from sparsestreet.pruning.select import (
    PruningRule,
    RenderContext,
    keep_by_cost,
    keep_by_importance,
    keep_by_rank,
)

__all__ = [
    "Floors",
    "Gathered",
    "Importance",
    "ImportanceRule",
    "InstanceAreas",
    "LeaveOneOutRule",
    "LightGaussianRule",
    "MiniSplattingRule",
    "OpacityRule",
    "PruningRule",
    "RandomRule",
    "RenderContext",
    "keep_by_cost",
    "keep_by_importance",
    "keep_by_rank",
    "regions",
]
