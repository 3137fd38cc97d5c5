"""What a training leaves for everybody else: the scene, the views it was made from, and what made it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from lightning import Callback, Trainer
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation.speed import device_name
from sparsestreet.noise import Calibration, calibrate, noise_between
from sparsestreet.phases import stage
from sparsestreet.records.curves import CountChange
from sparsestreet.records.run import RIG, RUN, Matrix, RigRecord, RunDescription
from sparsestreet.scene import views
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.storage import FILE_NAME, StoredScene, save_scene
from sparsestreet.training.callbacks.clock import Clock
from sparsestreet.training.callbacks.graceful_stop import TornStop
from sparsestreet.training.callbacks.resizing import RowListener
from sparsestreet.training.lightning import data_of, steps_for
from sparsestreet.training.system import StreetSystem


class RunFiles(Callback, RowListener):
    """Writes the scene, ``views.json``, ``rig.json`` and ``run.json`` when training ends, or is interrupted.

    Of several processes only the first writes.

    Args:
        folder: of the run.
        description: what is known of the run before it starts.
        clock: the wall time of training.
    """

    def __init__(self, folder: Path, description: RunDescription, clock: Clock) -> None:
        self.folder = folder
        self.description = description
        self.clock = clock
        self.caps: dict[str, int] = {}
        """Nodes that their limit held down -> the limit."""
        self._limits: dict[str, int | None] = {}
        self._calibration: Calibration | None = None

    def setup(self, trainer: Trainer, pl_module: StreetSystem, stage: str) -> None:
        self._limits = {name: node.settings.max_gaussians for name, node in pl_module.scene.nodes.items()}

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._calibration = calibrate(pl_module.device)

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        limit = self._limits[change.node]
        # A split adds two: one row below the limit there is no room for it either.
        if limit is not None and change.after > change.before and change.after >= limit - 1:
            self.caps[change.node] = limit

    def on_train_end(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if not trainer.interrupted:
            self.write(trainer, pl_module)

    def on_exception(self, trainer: Trainer, pl_module: StreetSystem, exception: BaseException) -> None:
        if trainer.global_step > 0 and not isinstance(exception, TornStop | OSError):
            self.write(trainer, pl_module)

    def write(self, trainer: Trainer, system: StreetSystem) -> None:
        """Leave the files as training stands now."""
        if not trainer.is_global_zero:
            return
        system.settle()
        before = self._calibration
        description = replace(
            self.description,
            device=device_name(system.device),
            threads=torch.get_num_threads(),
            steps=trainer.global_step,
            max_steps=system.course.steps if system.course.changed else steps_for(trainer, self.description.max_steps),
            training_seconds=self.clock.seconds,
            noise=None if before is None else noise_between(before, calibrate(system.device)),
            caps=dict(self.caps),
            held_back=dict(system.held_back),
            rested=dict(system.quarantine.counts),
        )
        data = data_of(trainer)
        log, split = data.driving_log, data.split
        stored = StoredScene(system.scene, system.options, log.name, log.num_frames)
        with stage("save"):
            save_scene(self.folder / FILE_NAME, stored)
            views.write_views(
                self.folder / views.FILE_NAME, split.train.views, split.held_out.views, frame_rate=log.frame_rate
            )
            RIG.write(self.folder, _rig(log))
            RUN.write(self.folder, description)

    def state_dict(self) -> dict[str, Any]:
        return {"caps": self.caps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.caps = dict(state_dict["caps"])


def _rig(log: DrivingLog) -> RigRecord:
    vehicle = log.vehicle
    return RigRecord(
        camera_names=log.camera_names,
        dataset_from_world=_matrix(log.dataset_from_world),
        world_from_vehicle=None if vehicle is None else tuple(_matrix(pose) for pose in vehicle.poses),
        vehicle_stamps=None if vehicle is None else vehicle.stamps,
    )


def _matrix(pose: Float64[Tensor, "4 4"]) -> Matrix:
    return tuple(tuple(row) for row in pose.tolist())
