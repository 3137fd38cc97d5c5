"""``sparsestreet bench data``: how long a step waits for its frame, beside a device that takes a fixed time for a step.

The device sleeps, so no GPU is needed: the host has its cores for the frames, as it has beside a real one.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from sparsestreet.bench.made_up import MadeUpDrive
from sparsestreet.bench.records import RecordFile
from sparsestreet.data.datamodule import StreetData
from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.evaluation.speed import peak_megabytes

FULL, QUICK = MadeUpDrive(200, 1920, 1280, 150_000), MadeUpDrive(6, 96, 64, 500)
STEP_MS = 5.0
EPOCHS = 4


@dataclass(frozen=True)
class EpochWaits:
    """What the steps of an epoch waited for."""

    width: int
    """Of the images as they are read, pixels."""
    epoch: int
    steps: int
    step_ms: float
    """Of the device."""
    wait_ms: float
    """Mean over the steps."""
    median_ms: float
    p99_ms: float
    cpu_ms: float
    """Of all threads of the process for a step: over ``step_ms``, the cores that would hide it."""
    share: float
    """Of the time of the epoch, the device's included, that was waited."""
    peak_mb: float
    """Most memory of the process until now."""


def run_data(drive: MadeUpDrive, folder: Path, file: RecordFile, say: Callable[[str], None] = print) -> None:
    """Takes the frames of some epochs from a drive below ``folder``, read at half its width and then whole."""
    root = folder / f"drive_{drive.images}x{drive.width}x{drive.height}"
    drive.write(root, say)
    for width in (drive.width // 2, drive.width):
        data = StreetData(DriveStudioReader(root, width=width).read(), stride=0)
        loader = data.train_dataloader()
        for epoch in range(EPOCHS):
            begin = time.process_time()
            waits = _waits(loader)
            record = _record(width, epoch, waits, time.process_time() - begin)
            file.write("data", record)
            say(
                f"{width} px, epoch {epoch}: a step waits {record.wait_ms:.3f} ms for its frame "
                f"(median {record.median_ms:.3f}, p99 {record.p99_ms:.3f}), {100 * record.share:.1f} % of its time; "
                f"{record.cpu_ms:.2f} ms of all cores; {record.peak_mb:.0f} MB at most"
            )
        data.teardown("fit")


def _waits(loader: Iterable) -> list[float]:
    """Milliseconds before each step of an epoch."""
    waits, frames = [], iter(loader)
    while True:
        start = time.perf_counter()
        if next(frames, None) is None:
            return waits
        waits.append(1e3 * (time.perf_counter() - start))
        time.sleep(1e-3 * STEP_MS)


def _record(width: int, epoch: int, waits: list[float], cpu_seconds: float) -> EpochWaits:
    total, (median, p99) = sum(waits), np.quantile(waits, (0.5, 0.99))
    return EpochWaits(
        width=width,
        epoch=epoch,
        steps=len(waits),
        step_ms=STEP_MS,
        wait_ms=total / len(waits),
        median_ms=float(median),
        p99_ms=float(p99),
        cpu_ms=1e3 * cpu_seconds / len(waits),
        share=total / (total + STEP_MS * len(waits)),
        peak_mb=peak_megabytes(torch.device("cpu"))[0],
    )
