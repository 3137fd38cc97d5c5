"""The device that a command asks for, and the one that a job of many gets."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig

from sparsestreet.cli.locks import hold, let_go
from sparsestreet.cli.process import shares_a_run

GPU = ("gpu", "cuda")
"""Words of ``trainer.accelerator`` that ask for a CUDA device; ``auto`` takes one where there is one."""


def device_of(name: str, asker: str, remedy: str) -> torch.device:
    """The device by name: cpu, cuda, or a GPU by its number, as cuda:1.

    Raises ValueError for any other name, and where torch sees no GPU: what needs one (``asker``) and what would help.
    """
    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {name!r}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"{asker} needs a CUDA device and torch sees none: {remedy}")
    return torch.device(name)


def device_problem(trainer: DictConfig) -> str | None:
    """What is asked of devices that cannot be, in one sentence; None where it can."""
    devices = trainer.get("devices", 1)
    if trainer.get("accelerator") in GPU:
        try:
            device_of("cuda", "trainer=gpu", "sparsestreet check says why; trainer=cpu trains without")
        except ValueError as error:
            return str(error)
    if shares_a_run(trainer):
        return None
    named = _named(devices)
    if (devices not in (1, "1", "auto")) if named is None else len(named) != 1:
        return (
            f"training runs on one device, got trainer.devices={devices}: trainer=ddp shares a run among several, and "
            "a sweep gives each of its jobs one"
        )
    if named and not _on_gpu(trainer):
        return f"trainer.devices={devices} names a GPU, and this run has none: say trainer=gpu, or leave it out"
    if named and named[0] not in range(there := torch.cuda.device_count()):
        return f"trainer.devices={devices} is not there: torch sees {there} of them, numbered from 0"
    return None


@contextmanager
def devices_of_job(trainer: DictConfig) -> Iterator[Any]:
    """What Lightning takes as the devices of a run, while the block runs.

    Runs that share a machine spread: each takes the GPU that the fewest others of this user hold. With more runs than
    devices they share these evenly; nobody waits. A run on the CPU, or of several processes, has what is asked.
    """
    devices = trainer.get("devices", 1)
    if shares_a_run(trainer) or not _on_gpu(trainer):
        yield devices
        return
    names = _names(torch.cuda.device_count())
    choice = _named(devices) or range(len(names))
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
            held = hold(path)
            if held is not None:
                try:
                    yield place
                finally:
                    let_go(path, held)
                return


def _on_gpu(trainer: DictConfig) -> bool:
    accelerator = trainer.get("accelerator")
    return accelerator in GPU or (accelerator in (None, "auto") and torch.cuda.is_available())


def _names(there: int) -> list[str]:
    """Of the devices that torch numbers: the same device has the same name in processes that see others."""
    visible = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return [f"cuda{name}" for name in (visible if len(visible) == there else range(there))]


def _named(devices: Any) -> list[int] | None:
    """The devices that are named by their numbers, as Lightning reads them ([3], "3," or "2,3"); None for a count."""
    if isinstance(devices, str) and "," in devices:
        return [int(part) for part in devices.split(",") if part.strip()]
    return list(devices) if isinstance(devices, list | ListConfig) else None
