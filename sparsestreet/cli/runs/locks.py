"""Locks that the kernel releases when their process dies: of a run's folder, and of the device that a job gets."""

import os
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sparsestreet.atomic import acquire_lock, release_lock
from sparsestreet.cli.config.validate import named_devices, on_gpu
from sparsestreet.cli.process import shares_a_run

LOCK = ".lock"
"""In the folder of a run that is being written."""


class FolderTakenError(OSError):
    """Another process writes into the folder of a run."""


@contextmanager
def sole_writer(out: Path) -> Iterator[None]:
    """Nobody else writes into a run's folder while the block runs.

    Where the folder lies on NFS, computers see each other's locks only as far as its server hands them on.

    Raises FolderTakenError, naming who writes there, where somebody else does; nothing is touched then.
    """
    path = out / LOCK
    out.mkdir(parents=True, exist_ok=True)
    held = acquire_lock(path)
    if held is None:
        raise FolderTakenError(
            f"{out} is being written by {_holder(path)}: wait for that run, end it, or name another place with out=..."
        )
    try:
        os.truncate(held, 0)
        os.write(held, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        release_lock(path, held)


def _holder(path: Path) -> str:
    try:
        return path.read_text() or "another process"
    except OSError:
        return "another process"


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
    import torch  # seconds, which a refused start does not wait for

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
            held = acquire_lock(path)
            if held is not None:
                try:
                    yield place
                finally:
                    release_lock(path, held)
                return


def _names(there: int) -> list[str]:
    """Of the devices that torch numbers: the same device has the same name in processes that see others."""
    visible = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return [f"cuda{name}" for name in (visible if len(visible) == there else range(there))]
