"""Runs a function in several processes of this one, as Lightning or torchrun would start them."""

import multiprocessing
import os
import socket
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer

from sparsestreet.training.parallel import DataParallel
from sparsestreet.training.run import CPU_TRAINER

PATIENCE = 30.0
"""Seconds for which processes wait for each other."""


def several(size: int, work: Callable[[int], Any], folder: Path) -> list[Any]:
    """What ``work(rank)`` answers in each process, in their order; None of one that ended otherwise.

    Forked, because importing torch takes seconds; answers travel as files in the folder.
    """
    port = _free_port()
    fork = multiprocessing.get_context("fork")
    processes = [fork.Process(target=_run, args=(rank, size, port, work, folder)) for rank in range(size)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    files = [folder / f"answer {rank}.pt" for rank in range(size)]
    return [torch.load(file, weights_only=False) if file.is_file() else None for file in files]


def trainers(size: int, **settings: Any) -> Callable[..., Trainer]:
    """What makes the trainer of one of several processes."""
    return partial(
        CPU_TRAINER, strategy=DataParallel(patience=PATIENCE), devices=size, **{"limit_val_batches": 0} | settings
    )


def _run(rank: int, size: int, port: int, work: Callable[[int], Any], folder: Path) -> None:
    torch.set_num_threads(1)  # those of the process that was forked are not there
    warnings.simplefilter("ignore")
    where = {"LOCAL_RANK": rank, "NODE_RANK": 0, "WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in where.items()})
    torch.save(work(rank), folder / f"answer {rank}.pt")


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]
