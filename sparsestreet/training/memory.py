"""Whether a device can hold a scene as large as it may get, said before the first step; and what fits later on."""

import logging

import torch

from sparsestreet.data import frame_cache
from sparsestreet.data.datamodule import StreetData
from sparsestreet.scene.gaussians import Rows
from sparsestreet.training.forecast import largest
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

COPIES = 4
"""Of each column: values, gradient and Adam's two moments."""
STEP_BYTES = 350
"""For each Gaussian, what a step projects, sorts and differentiates beside its columns: 341 with 5 million Gaussians at
1920x1280 on an H100 (benchmarks/gpu.jsonl, peak less values and gradients)."""
PIXEL_BYTES = 51
"""For each pixel of an image: from 960x640 to 1920x1280 with 1,000 Gaussians, from the same records."""


MARGIN = 0.1
"""Of what is free, left to others: allocators round, and images differ in what they need."""


def foreseen_bytes(rows: int, row_bytes: float, pixels: int) -> float:
    """What a training step needs on its device at once, in each process: all have all Gaussians.

    Args:
        rows: Gaussians.
        row_bytes: of the columns of one.
        pixels: of the largest image.

    >>> f"{foreseen_bytes(5_000_000, 236.0, 1920 * 1280) / 1e9:.1f} GB"
    '6.6 GB'
    """
    return rows * (COPIES * row_bytes + STEP_BYTES) + PIXEL_BYTES * pixels


def memory_problem(now: int, grown: int, row_bytes: float, pixels: int, available: float) -> str | None:
    """A warning where the scene may outgrow ``available`` bytes; None where it cannot.

    Raises ValueError where not even the Gaussians at the start fit.
    """
    needed = foreseen_bytes(grown, row_bytes, pixels)
    if needed <= available:
        return None
    start = foreseen_bytes(now, row_bytes, pixels)
    rows, needed = (now, start) if start > available else (grown, needed)
    said = (
        f"{rows:,} Gaussians and an image of {pixels:,} pixels need about {needed / 1e9:.1f} GB, and the device has "
        f"{available / 1e9:.1f} GB: lower max_gaussians of the largest nodes, or the size of the images. More "
        "processes do not help, since each holds all Gaussians"
    )
    if start > available:
        raise ValueError(said)
    return f"the scene may outgrow the device: {said}"


def bytes_of_row(rows: Rows) -> int:
    """What a step needs for one more Gaussian of a node."""
    columns = rows.columns().values()
    return COPIES * sum(column[:1].numel() * column.element_size() for column in columns) + STEP_BYTES


def bytes_for_growth(device: torch.device) -> float:
    """What Gaussians that are added now may take: of a GPU what a step has left at its peak so far, of the host what
    is free; infinite where a host does not say. Nothing waits."""
    if device.type == "cuda":
        free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
        return (1 - MARGIN) * (free - torch.cuda.max_memory_allocated(device))
    free = frame_cache.free_bytes()
    return float("inf") if free is None else (1 - MARGIN) * free


def report_memory(system: StreetSystem, data: StreetData) -> None:
    """Say what a GPU will have to hold. Raises ValueError where it cannot hold the start."""
    if system.device.type != "cuda":
        return
    columns = [column for node in system.scene.nodes.values() for column in node.rows.columns().values()]
    now = sum(system.scene.counts().values())
    row_bytes = sum(column.numel() * column.element_size() for column in columns) / max(now, 1)
    pixels = max(view.camera.width * view.camera.height for view in data.split.train.views)
    # What torch holds already will serve.
    available = torch.cuda.mem_get_info(system.device)[0] + torch.cuda.memory_reserved(system.device)
    if problem := memory_problem(now, largest(system), row_bytes, pixels, available):
        log.warning(problem)
