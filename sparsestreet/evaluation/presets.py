"""What it costs and saves to render a trained scene in another way than it was trained."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from sparsestreet.data.device import to_device
from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation.evaluate import frame_quality, screen_image
from sparsestreet.evaluation.predictions import quantized, restored
from sparsestreet.evaluation.speed import device_name, frame_image
from sparsestreet.metrics.image import psnr
from sparsestreet.noise import calibrate, noise_between
from sparsestreet.ops import SplatSettings
from sparsestreet.phases import clock_of
from sparsestreet.records.renders import PresetRecord, RenderedAs
from sparsestreet.records.summary import FrameQuality, summarize
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions
from sparsestreet.types import View

ROUNDS = 4
"""Over all views, in which every preset is timed once a view."""
SLOW_MS = 200.0
"""A preset whose frames take longer is timed in the first round alone."""


@torch.no_grad()
def evaluate_presets(
    scene: SceneGraph, frames: Frames, presets: Mapping[str, RenderOptions], trained: RenderOptions, *, command: str
) -> PresetRecord:
    """Quality, distance to the exact image and milliseconds of each way to render, over the same views.

    Args:
        scene: on the device where it renders; stays as it is.
        frames: recorded views, best those that training did not see; one image at a time is in memory.
        presets: name -> how to render.
        trained: how the scene was rendered in training; its backend renders all presets.
        command: that asked for it.

    Raises ValueError without views or presets, or for renders that are not finite.
    """
    if not frames or not presets:
        raise ValueError(f"give views and at least one preset, got {len(frames)} and {list(presets)}")
    before = calibrate(scene.device)
    ways = {name: replace(options, backend=trained.backend) for name, options in presets.items()}
    quality, distances = _looks(scene, frames, ways, replace(trained, settings=_exact(trained.settings)))
    times = _frame_times(scene, frames.views, ways)
    rendered = tuple(
        RenderedAs(
            preset=name,
            trained=options == trained,
            quality={metric: one.mean for metric, one in summarize(quality[name]).items() if one.mean is not None},
            psnr_to_exact=statistics.fmean(distances[name]),
            frame_ms=statistics.median(times[name]),
            repeats=len(times[name]),
        )
        for name, options in ways.items()
    )
    return PresetRecord(
        command=command,
        device=device_name(scene.device),
        threads=torch.get_num_threads(),
        views=len(frames),
        noise=noise_between(before, calibrate(scene.device)),
        rendered=rendered,
    )


def _looks(
    scene: SceneGraph, frames: Frames, ways: Mapping[str, RenderOptions], exact: RenderOptions
) -> tuple[dict[str, list[FrameQuality]], dict[str, list[float]]]:
    """Of each way its quality, rounded as predictions are, and its distance to the exact image, frame by frame."""
    quality: dict[str, list[FrameQuality]] = {name: [] for name in ways}
    distances: dict[str, list[float]] = {name: [] for name in ways}
    for recorded in frames:
        frame = to_device(recorded, scene.device)
        limit = screen_image(scene, frame, exact)
        for name, options in ways.items():
            image = limit if options == exact else screen_image(scene, frame, options)
            shown = torch.from_numpy(restored(quantized(image.cpu().numpy()))).to(scene.device)
            quality[name].append(frame_quality(shown, frame, {}))
            distances[name].append(psnr(image, limit))
    return quality, distances


def _frame_times(scene: SceneGraph, views: Sequence[View], ways: Mapping[str, RenderOptions]) -> dict[str, list[float]]:
    """Milliseconds of single frames, the ways in turn at each view: what drifts meets all of them alike."""
    clock = clock_of(scene.device)
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(ROUNDS):
        timed = {
            name: options for name, options in ways.items() if not turn or statistics.median(times[name]) < SLOW_MS
        }
        for view in views:
            for name, options in timed.items():
                start = clock.mark()
                frame_image(scene, view, options)
                times[name].append(1000 * clock.seconds(start, clock.mark()))
    return times


def _exact(settings: SplatSettings) -> SplatSettings:
    """No splat ends, no pixel stops and nothing is rounded; what a splat is (its clamp, its low-pass) stays."""
    return replace(settings, alpha_min=0.0, transmittance_min=0.0, max_sigma=math.inf, half_colors=False, depth_bits=32)
