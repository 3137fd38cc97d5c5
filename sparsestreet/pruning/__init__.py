"""Scores Gaussians over all training views and selects which to keep.

``rule`` is the interface of the rules, ``importance`` the paper's score, ``rules`` the paper's rule and ours (leave
one out). ``published`` has the rules of other papers, ``controls`` those that look at no image. ``counts`` keep a given
number of each node, ``select`` drops rows by scores but respects the ``floors`` of a node and its instances.
"""

from sparsestreet.pruning.importance import (
    Importance,
    LightGaussianRule,
    MiniSplattingRule,
    OpacityRule,
    RandomRule,
    measure_importance,
)
from sparsestreet.pruning.rules import ImportanceRule, LeaveOneOutRule
from sparsestreet.pruning.select import (
    Floors,
    InstanceAreas,
    PruningRule,
    RenderContext,
    keep_by_cost,
    keep_by_importance,
    keep_by_rank,
)

__all__ = [
    "Floors",
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
    "measure_importance",
]
