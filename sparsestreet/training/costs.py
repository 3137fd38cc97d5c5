"""What a training cost in time and memory, for ``records/cost.json``."""

from pathlib import Path

import torch

from sparsestreet.evaluation.speed import peak_megabytes
from sparsestreet.phases import StageRecorder
from sparsestreet.records.costs import stage_costs, step_costs, update_costs


def record_costs(out: Path, stages: StageRecorder, device: torch.device) -> None:
    """Write the seconds of every stage until now, the milliseconds of a step's parts, and the peaks of memory."""
    host, on_device = peak_megabytes(device)
    seconds = stages.seconds()
    phases, passes = stage_costs(seconds)
    update_costs(
        out,
        wall_seconds=sum(seconds.values()),
        phases=phases,
        passes=passes,
        step_ms=step_costs(out),
        peak_host_mb=host,
        peak_device_mb=on_device,
    )
