"""Scores Gaussians over all training views and selects which to keep.

``rule`` is the interface of the rules, ``importance`` the paper's score, ``rules`` the paper's rule and ours (leave
one out). ``controls`` keep a given number at random or by opacity. ``select`` drops rows by scores but respects the
``floors`` of a node and its instances.
"""

from sparsestreet.pruning.controls import OpacityRule, RandomRule
from sparsestreet.pruning.floors import Floors, InstanceAreas
from sparsestreet.pruning.importance import Importance, measure_importance
from sparsestreet.pruning.rule import PruningRule, RenderContext
from sparsestreet.pruning.rules import ImportanceRule, LeaveOneOutRule
from sparsestreet.pruning.select import keep_by_cost, keep_by_importance, keep_by_rank

__all__ = [
    "Floors",
    "Importance",
    "ImportanceRule",
    "InstanceAreas",
    "LeaveOneOutRule",
    "OpacityRule",
    "PruningRule",
    "RandomRule",
    "RenderContext",
    "keep_by_cost",
    "keep_by_importance",
    "keep_by_rank",
    "measure_importance",
]
