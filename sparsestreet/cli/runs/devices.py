"""The device that a job of many gets."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from sparsestreet.cli.config.validate import named_devices, on_gpu
from sparsestreet.cli.process import shares_a_run
from sparsestreet.cli.runs.locks import acquire, release


@contextmanager
def devices_of_job(trainer: DictConfig) -> Iterator[Any]:
    """What Lightning takes as the devices of a run, while the block runs.

    Runs that share a machine spread: each takes the GPU that the fewest others of this user hold. With more runs than
    devices they share these evenly; nobody waits. A run on the CPU, or of several processes, has what is asked.
    """
    devices = trainer.get("devices", 1)
    if shares_a_run(trainer) or not on_gpu(trainer):
        yield devices
        return
    names = _names(torch.cuda.device_count())
    choice = named_devices(devices) or range(len(names))
    with least_held([names[index] for index in choice]) as place:
        yield [choice[place]]


@contextmanager
def least_held(names: Sequence[str]) -> Iterator[int]:
    """The place of the name that the fewest processes of this user hold; held, once more, while the block runs.

    Each name has slots, files whose locks the kernel releases when a process dies. The first free slot of all names is
    taken, then the second.
    """
    folder = Path(tempfile.gettempdir(), f"sparsestreet-{os.getuid()}")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for slot in count():
        for place, name in enumerate(names):
            path = folder / f"{name}.{slot}"
            held = acquire(path)
            if held is not None:
                try:
                    yield place
                finally:
                    release(path, held)
                return


def _names(there: int) -> list[str]:
    """Of the devices that torch numbers: the same device has the same name in processes that see others."""
    visible = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return [f"cuda{name}" for name in (visible if len(visible) == there else range(there))]
