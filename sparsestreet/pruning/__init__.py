"""Scores of Gaussians and the rules that select which to keep."""

from sparsestreet.pruning.importance import Importance, measure_importance
from sparsestreet.pruning.rules import ImportanceRule, LeaveOneOutRule, PruningRule, View
from sparsestreet.pruning.select import Selection, keep_by_cost, keep_by_importance, keep_by_mask

__all__ = [
    "Importance",
    "ImportanceRule",
    "LeaveOneOutRule",
    "PruningRule",
    "Selection",
    "View",
    "keep_by_cost",
    "keep_by_importance",
    "keep_by_mask",
    "measure_importance",
]
