"""What steps say to the loggers. These get it when it has arrived on the host: to ask for it would wait for a GPU."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lightning import Trainer
from torch import Tensor

from sparsestreet.host_copy import HostCopy, copy_to_host
from sparsestreet.training.lightning import log_numbers, logged_number


@dataclass(frozen=True)
class _Step:
    """What one step says."""

    number: int
    filed: int
    """Under which number the loggers file it."""
    epoch: int
    names: tuple[str, ...]
    values: HostCopy
    known: Mapping[str, float]
    """What the host knows already."""

    def arrived(self) -> dict[str, float]:
        """By name; waits for the copy."""
        return dict(zip(self.names, self.values.wait().tolist(), strict=True)) | dict(self.known)


class SaidLater:
    """Keeps what the newest step that logs has said until somebody passes it on."""

    def __init__(self) -> None:
        self._step: _Step | None = None
        self._newest: dict[str, float] = {}

    def say(self, trainer: Trainer, values: Mapping[str, Tensor], known: Mapping[str, float]) -> None:
        """Queue the copies of a step's numbers; of several images of a step the last is heard."""
        numbers = torch.stack([value.detach().double() for value in values.values()])
        place = trainer.global_step, logged_number(trainer), trainer.current_epoch
        self._step = _Step(*place, tuple(values), copy_to_host(numbers), known)

    def pass_on(self, trainer: Trainer) -> None:
        """Hand what an earlier step has said to Lightning's loggers, under that step; waits if it is not there yet."""
        if self._step is not None and self._step.number < trainer.global_step:
            step, self._step = self._step, None
            self._newest = step.arrived()
            numbers: dict[str, Any] = {**self._newest, "epoch": step.epoch}
            log_numbers(trainer, numbers, step.filed)

    @property
    def is_there(self) -> bool:
        """Whether there is something to pass on, and it has arrived."""
        return self._step is not None and self._step.values.ready

    @property
    def newest(self) -> Mapping[str, float]:
        """What has arrived last, without a wait."""
        return self._newest if self._step is None or not self.is_there else self._step.arrived()
