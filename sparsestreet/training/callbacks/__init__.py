"""Callbacks know WHEN; what they apply is decided by pure functions in scene/density, scene/masks and pruning.

They act in the order in which they are configured: ``density_control``, ``mask_training``, ``pruning``, all
through ``resizing``. ``row_ledger``, ``phase_times``, ``held_out_curve`` and ``progress`` look on, ``clock`` and
``stage_times`` count seconds, ``pace`` foretells them;
``checkpoints``, ``run_files`` and ``graceful_stop`` see to what a run leaves, also one that is interrupted.
"""

from sparsestreet.training.callbacks.checkpoints import Checkpoints, newest_checkpoint, step_of
from sparsestreet.training.callbacks.clock import Clock
from sparsestreet.training.callbacks.density_control import DensityControl
from sparsestreet.training.callbacks.graceful_stop import GracefulStop
from sparsestreet.training.callbacks.held_out_curve import HeldOutCurve
from sparsestreet.training.callbacks.mask_training import MaskTraining
from sparsestreet.training.callbacks.pace import Pace
from sparsestreet.training.callbacks.phase_times import PhaseTimes
from sparsestreet.training.callbacks.progress import TrainingProgress
from sparsestreet.training.callbacks.pruning import Pruning
from sparsestreet.training.callbacks.row_ledger import RowLedger
from sparsestreet.training.callbacks.run_files import RunFiles
from sparsestreet.training.callbacks.stage_times import StageTimes

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
