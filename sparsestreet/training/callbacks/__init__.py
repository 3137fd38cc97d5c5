"""Callbacks know WHEN; what they apply is decided by pure functions in scene/density, scene/masks and pruning.

They act in the order in which they are configured: ``density_control``, then ``sparsify``. ``times`` and ``progress``
look on; ``files`` sees to what a run leaves, also one that is interrupted.
"""

from sparsestreet.training.callbacks.density_control import DensityControl
from sparsestreet.training.callbacks.files import Checkpoints, GracefulStop, RunFiles, newest_checkpoint, step_of
from sparsestreet.training.callbacks.progress import Pace, TrainingProgress
from sparsestreet.training.callbacks.sparsify import MaskTraining, Pruning
from sparsestreet.training.callbacks.times import Clock, HeldOutCurve, PhaseTimes, RowLedger, StageTimes

__all__ = [
    "Checkpoints",
    "Clock",
    "DensityControl",
    "GracefulStop",
    "HeldOutCurve",
    "MaskTraining",
    "Pace",
    "PhaseTimes",
    "Pruning",
    "RowLedger",
    "RunFiles",
    "StageTimes",
    "TrainingProgress",
    "newest_checkpoint",
    "step_of",
]
