"""How long one image takes: medians over many renders, with the device waited for."""

import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from sparsestreet.evaluation.evaluate import RenderedImage
from sparsestreet.evaluation.provenance import processor_name
from sparsestreet.evaluation.records import Latency
from sparsestreet.types import Frame


def measure_latency(
    render: Callable[[Frame], RenderedImage], frames: Sequence[Frame], *, warmup: int = 20, repeats: int = 50
) -> Latency:
    """Wall clock of ``render(frame)``, milliseconds.

    The protocol, which the answer repeats in words: batch of one; ``warmup`` renders that are thrown away, then
    ``repeats`` timed ones, cycling through all ``frames`` so that no easy view is singled out. The clock holds all
    that a view needs (assembling the scene at that time, projection, blending, sky) and neither loading of images
    nor metrics nor conversion to uint8. On a CUDA device it waits for the device before and after each render.
    The median is the headline: the mean of timings with a slow tail is several times noisier. A published number
    needs ``repeats`` >= 50. Frames per second are 1000 / p50, never the mean of 1 / t.

    Raises ValueError without frames, or if ``warmup`` or ``repeats`` is below 1.
    """
    if not frames or warmup < 1 or repeats < 1:
        raise ValueError(
            f"latency needs at least one frame, warm-up and repeat, got {len(frames)}, {warmup} and {repeats}"
        )
    with torch.no_grad():
        for index in range(warmup):
            device = render(frames[index % len(frames)]).rgb.device
        timings = [_milliseconds(render, frames[index % len(frames)], device) for index in range(repeats)]
    p50, p90, p99 = (float(value) for value in np.percentile(timings, (50, 90, 99)))
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name()
    return Latency(p50, p90, p99, repeats, warmup, len(frames), f"{device.type}: {name}", torch.get_num_threads())


def _milliseconds(render: Callable[[Frame], RenderedImage], frame: Frame, device: torch.device) -> float:
    _wait_for(device)
    start = time.perf_counter()
    render(frame)
    _wait_for(device)
    return 1000 * (time.perf_counter() - start)


def _wait_for(device: torch.device) -> None:
    """CUDA kernels run behind the host's back: without this the clock sees launches only."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
