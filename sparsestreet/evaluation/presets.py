"""What it costs and saves to render a trained scene in another way than it was trained."""

import math
from collections.abc import Mapping
from dataclasses import replace
from statistics import fmean

import torch

from sparsestreet.data.lazy import Frames
from sparsestreet.evaluation.evaluate import evaluate_frames, screen_image
from sparsestreet.evaluation.noise import calibrate, noise_between
from sparsestreet.evaluation.preset_record import PresetRecord, RenderedAs
from sparsestreet.evaluation.quality import summarize
from sparsestreet.evaluation.records import FRAME, RASTER
from sparsestreet.evaluation.speed import device_name, measure_latency
from sparsestreet.metrics.image import psnr
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions


@torch.no_grad()
def evaluate_presets(
    scene: SceneGraph,
    frames: Frames,
    presets: Mapping[str, RenderOptions],
    trained: RenderOptions,
    *,
    command: str,
    warmup: int = 20,
    repeats: int = 50,
) -> PresetRecord:
    """Quality, distance to the exact image and milliseconds of each way to render, over the same views.

    Args:
        scene: on the device where it renders; stays as it is.
        frames: recorded views, best those that training did not see; one image at a time is in memory.
        presets: name -> how to render.
        trained: how the scene was rendered in training; its backend renders all presets.
        command: that asked for it.
        warmup, repeats: of the latency protocol.

    Raises ValueError without views or presets, or for renders that are not finite.
    """
    if not frames or not presets:
        raise ValueError(f"presets need views and at least one preset, got {len(frames)} and {list(presets)}")
    before = calibrate(scene.device)
    exact = replace(trained, settings=_exact(trained.settings))

    def rendered_as(name: str, options: RenderOptions) -> RenderedAs:
        options = replace(options, backend=trained.backend)
        summary = summarize(evaluate_frames(scene, frames, options))
        pairs = ((screen_image(scene, view, how) for how in (options, exact)) for view in frames.views)
        clocks = measure_latency(scene, frames.views, options, warmup=warmup, repeats=repeats).clocks
        return RenderedAs(
            preset=name,
            trained=options == trained,
            quality={metric: one.mean for metric, one in summary.items() if one.mean is not None},
            psnr_to_exact=fmean(psnr(*pair) for pair in pairs),
            frame_ms=clocks[FRAME].p50,
            raster_ms=clocks[RASTER].p50,
        )

    rendered = tuple(rendered_as(name, options) for name, options in presets.items())
    return PresetRecord(
        command=command,
        device=device_name(scene.device),
        threads=torch.get_num_threads(),
        views=len(frames),
        noise=noise_between(before, calibrate(scene.device)),
        rendered=rendered,
    )


def _exact(settings: SplatSettings) -> SplatSettings:
    """No splat ends, no pixel stops and nothing is rounded; what a splat is (its clamp, its low-pass) stays."""
    return replace(settings, alpha_min=0.0, transmittance_min=0.0, max_sigma=math.inf, half_colors=False, depth_bits=32)
