"""Callbacks know when; pure functions in scene/density, scene/masks and pruning decide what they apply.

``density_control`` adds, removes and resets rows, and has ``resize_rows``, through which every change goes.
``sparsify`` trains masks and prunes. ``times`` counts seconds and rows and takes looks at held-out views, ``progress``
shows the bar and foretells the pace. ``files`` writes checkpoints and a run's files, and ends a run after a signal.
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
