"""What the stages of a command do not see by themselves: validations, and what an interrupted command spent."""

from typing import Any

from lightning import Callback, LightningModule, Trainer

from sparsestreet.phases import StageRecorder


class StageTimes(Callback):
    """Takes validation out of training, and hands the seconds to the command that goes on with the run."""

    def __init__(self, recorder: StageRecorder) -> None:
        self.recorder = recorder

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.recorder.enter("validate")

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.recorder.leave()

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.recorder.seconds()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.recorder.go_on(state_dict["seconds"])
