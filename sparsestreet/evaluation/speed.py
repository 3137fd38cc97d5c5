"""How long one image takes: medians over many renders, with the device waited for."""

import time
from collections.abc import Sequence

import numpy as np
import torch

from sparsestreet.evaluation.provenance import processor_name
from sparsestreet.evaluation.records import Latency
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from sparsestreet.types import View


def measure_latency(
    scene: SceneGraph, views: Sequence[View], options: RenderOptions, *, warmup: int = 20, repeats: int = 50
) -> Latency:
    """Wall clock of rendering a view on the scene's device, milliseconds.

    The protocol, which the answer repeats in words: batch of one; ``warmup`` renders that are thrown away, then
    ``repeats`` timed ones, cycling through all ``views`` so that no easy view is singled out. The clock holds all
    that a view needs (assembling the scene at that time, projection, blending, sky) and neither loading of images
    nor metrics nor conversion to uint8. On a CUDA device it waits for the device before and after each render.
    The median is the headline: the mean of timings with a slow tail is several times noisier. A published number
    needs ``repeats`` >= 50. Frames per second are 1000 / p50, never the mean of 1 / t.

    Raises ValueError without views, or if ``warmup`` or ``repeats`` is below 1.
    """
    if not views or warmup < 1 or repeats < 1:
        raise ValueError(
            f"latency needs at least one view, warm-up and repeat, got {len(views)}, {warmup} and {repeats}"
        )
    with torch.no_grad():
        for index in range(warmup):
            render(scene, views[index % len(views)], options=options)
        timings = [_milliseconds(scene, views[index % len(views)], options) for index in range(repeats)]
    p50, p90, p99 = (float(value) for value in np.percentile(timings, (50, 90, 99)))
    return Latency(
        p50, p90, p99, repeats, warmup, len(views), device_name(scene.device), threads=torch.get_num_threads()
    )


def device_name(device: torch.device) -> str:
    """What a record calls a device, such as "cpu: Intel Xeon ..." or "cuda: NVIDIA H100"."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name()
    return f"{device.type}: {name}"


def _milliseconds(scene: SceneGraph, view: View, options: RenderOptions) -> float:
    _wait_for(scene.device)
    start = time.perf_counter()
    render(scene, view, options=options)
    _wait_for(scene.device)
    return 1000 * (time.perf_counter() - start)


def _wait_for(device: torch.device) -> None:
    """CUDA kernels run behind the host's back: without this the clock sees launches only."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
