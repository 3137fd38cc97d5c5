"""Callbacks know WHEN; what they apply is decided by pure functions in training/density and pruning.

They act in the order in which they are configured: density control, mask training, background pruning.
"""

from sparsestreet.training.callbacks.background_pruning import BackgroundPruning
from sparsestreet.training.callbacks.checkpoints import Checkpoints
from sparsestreet.training.callbacks.clock import Clock
from sparsestreet.training.callbacks.density_control import DensityControl
from sparsestreet.training.callbacks.mask_training import MaskTraining
from sparsestreet.training.callbacks.progress import TrainingProgress
from sparsestreet.training.callbacks.row_ledger import RowLedger

__all__ = [
    "BackgroundPruning",
    "Checkpoints",
    "Clock",
    "DensityControl",
    "MaskTraining",
    "RowLedger",
    "TrainingProgress",
]
