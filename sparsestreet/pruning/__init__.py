"""Scores of Gaussians over all training views, and the rules that select which to keep.

``importance`` is the paper's score; ``rules`` the paper's rule and ours (leave one out); ``select`` what is kept.
"""

from sparsestreet.pruning.importance import Importance, measure_importance
from sparsestreet.pruning.rules import ImportanceRule, LeaveOneOutRule, Look, PruningRule, prunable_floors
from sparsestreet.pruning.select import keep_by_cost, keep_by_importance

__all__ = [
    "Importance",
    "ImportanceRule",
    "LeaveOneOutRule",
    "Look",
    "PruningRule",
    "keep_by_cost",
    "keep_by_importance",
    "measure_importance",
    "prunable_floors",
]
