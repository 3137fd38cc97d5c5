"""Everything that is measured of a trained scene, and the files it leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sparsestreet.data.lazy import Frames, as_frames, spread
from sparsestreet.data.log import DrivingLog, Split
from sparsestreet.evaluation.evaluate import Predictions, evaluate_frames, lidar_masks, screen_image
from sparsestreet.evaluation.geometry import measure_geometry
from sparsestreet.evaluation.speed import Timing, measure_latency, measure_scene_costs, to_uint8
from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.metrics.lpips import open_lpips
from sparsestreet.ops import Guards, guards
from sparsestreet.phases import stage
from sparsestreet.pictures.images import KINDS, Picture, draw_lidar_end, error_picture, write_picture, write_png
from sparsestreet.pictures.sheets import Legend, picture_sheet
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.costs import EffectGain, update_costs
from sparsestreet.records.geometry import Geometry
from sparsestreet.records.run import RunDescription, this_machine, this_source
from sparsestreet.records.summary import (
    HELD_OUT,
    LATENCY,
    NOVEL,
    PRESETS,
    QUALITY,
    SUMMARY,
    TRAINING,
    Evaluation,
    FrameQuality,
    GuardCounts,
    Latency,
    RunSummary,
    camera_means,
    clock_rows,
    summarize,
)
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, node_legend, project_centers
from sparsestreet.scene.standing import StandingScene
from sparsestreet.types import Frame, View

MAX_IMAGES = 60
"""Images that are rendered without each effect, spread over all."""


@torch.no_grad()
def measure_effect_gains(
    scene: SceneGraph,
    frames: Frames,
    quality: Sequence[FrameQuality],
    options: RenderOptions,
    ranks: Ranks = ALONE,
) -> dict[str, EffectGain]:
    """Name of each effect of the scene -> its gain on ``frames``, of which ``quality`` is that of the whole scene.

    ``ranks``: as in ``evaluate_frames``.
    """
    chosen = spread(len(frames), MAX_IMAGES)
    whole = _means([quality[index] for index in chosen])
    gains = {}
    for name in (name for name, effect in scene.effects.items() if effect.is_on):
        without = _means(list(evaluate_frames(scene.without(name), frames.at(chosen), options, ranks=ranks)))
        full, vehicle, human = (_less(*pair) for pair in zip(whole, without, strict=True))
        if full is not None:
            gains[name] = EffectGain(full, vehicle, human, len(chosen))
    return gains


def _means(quality: Sequence[FrameQuality]) -> list[float | None]:
    summary = summarize(quality)
    return [summary[metric].mean for metric in ("psnr_full", "psnr_vehicle", "psnr_human")]


def _less(whole: float | None, without: float | None) -> float | None:
    return None if whole is None or without is None else whole - without


@torch.no_grad()
def evaluate_scene(
    scene: SceneGraph,
    held_out: Frames | tuple[Frame, ...],
    training: Frames | tuple[Frame, ...],
    *,
    run: RunDescription,
    options: RenderOptions,
    out: Path,
    command: str,
    device: torch.device | str,
    pictures: int = 4,
    timing: Timing | None = None,
    training_lpips: bool = False,
    log: DrivingLog | None = None,
    ranks: Ranks = ALONE,
) -> RunSummary:
    """Measure quality, speed and size of a scene; write ``out/records``, ``out/predictions`` and ``out/pictures``.

    The numbers of held-out views are computed from the predictions as they are stored; those of training views from
    renders rounded alike, where there are held-out views without the perceptual distances unless they are asked for.

    Speed, guards and pictures are of the held-out views, or of the training views where none is held out.

    Args:
        scene: moved to ``device``, where it stays.
        held_out: views that training never saw; may be empty.
        training: views that it saw; may be empty. Of both one image at a time is loaded, and none is kept.
        run: what identifies the run; goes into the record as it is.
        options: how the scene is rendered.
        out: the run's folder.
        command: that this evaluation was asked for with.
        device: where it is rendered and timed.
        pictures: how many views become pictures.
        timing: how often frames are timed; None: ``Timing()``.
        training_lpips: as in ``ExtraMetrics``.
        log: whose sweeps are compared with ranges of the scene; None: nothing is.
        ranks: the processes that measure quality together. This is the first; the others call ``help_to_evaluate``.

    Raises ValueError without any view, or for renders that are not finite, LostProcessError.
    """
    splits = _splits(held_out, training)
    if not splits:
        raise ValueError(f"there is no view to evaluate {run.label} on: give held-out views, training views or both")
    scene = StandingScene.of(scene.to(torch.device(device)).eval())
    main, frames = next(iter(splits.items()))
    for split in (HELD_OUT, TRAINING):
        Predictions.of(out, split).clear()
    for file in (NOVEL, PRESETS):
        file.remove(out)  # of an earlier evaluation, perhaps of an earlier scene
    quality, gains, absent = _looks(scene, splits, options, out, ranks, training_lpips)
    timing = timing or Timing()
    with stage("latency"):
        latency = measure_latency(scene, frames.views, options, warmup=timing.warmup, repeats=timing.repeats)
    with stage("costs"):
        costs = measure_scene_costs(scene, frames.views, options, repeats=timing.rounds)
    with stage("geometry"):
        held_out_indices = Split(as_frames(training), as_frames(held_out)).held_out_indices
        geometry = None if log is None else measure_geometry(scene, log, held_out_indices, options)
    if log is not None and log.sweeps and geometry is None:
        absent = {**absent, "geometry": "no sweep tells where its lidar stood: read the log by a reader that knows"}
    summary = _summary(
        scene, quality, latency, _guard_counts(scene, frames.views, options), run, command, absent, geometry
    )
    with stage("pictures"):
        chosen = [_picture(scene, frames[index], options) for index in choose_pictures(quality[main], pictures)]
        _write_pictures(chosen, summary, node_legend(scene.counts()), out / "pictures")
    for split in (HELD_OUT, TRAINING):
        QUALITY[split].remove(out)  # of an earlier evaluation, perhaps on more views
    for split, images in quality.items():
        QUALITY[split].write(out, images)
    LATENCY.write(out, clock_rows(latency))
    update_costs(out, **vars(costs), gains=gains)
    SUMMARY.write(out, summary)
    return summary


@torch.no_grad()
def help_to_evaluate(
    scene: SceneGraph,
    held_out: Frames | tuple[Frame, ...],
    training: Frames | tuple[Frame, ...],
    *,
    options: RenderOptions,
    out: Path,
    device: torch.device | str,
    ranks: Ranks,
    training_lpips: bool = False,
) -> None:
    """A process's share of what the first one measures in ``evaluate_scene``; writes nothing. Ends before frames are
    timed, so that nobody else computes then. Raises as ``evaluate_scene``."""
    splits = _splits(held_out, training)
    if splits:
        _looks(StandingScene.of(scene.to(torch.device(device)).eval()), splits, options, out, ranks, training_lpips)


def _splits(held_out: Frames | tuple[Frame, ...], training: Frames | tuple[Frame, ...]) -> dict[str, Frames]:
    return {split: as_frames(frames) for split, frames in ((HELD_OUT, held_out), (TRAINING, training)) if frames}


def _looks(
    scene: SceneGraph,
    splits: Mapping[str, Frames],
    options: RenderOptions,
    out: Path,
    ranks: Ranks,
    training_lpips: bool,
) -> tuple[dict[str, list[FrameQuality]], dict[str, EffectGain], Mapping[str, str]]:
    """Quality by split, gains of effects, and which distances could not be measured and why."""
    main, frames = next(iter(splits.items()))
    lpips, absent = open_lpips(scene.device)
    quality = {
        split: list(
            evaluate_frames(
                scene,
                views,
                options,
                Predictions.of(out, split) if split == HELD_OUT else None,
                lpips if split == main or training_lpips else {},
                ranks,
            )
        )
        for split, views in splits.items()
    }
    with stage("gains"):
        gains = measure_effect_gains(scene, frames, quality[main], options, ranks)
    return quality, gains, absent


def _guard_counts(scene: SceneGraph, views: Sequence[View], options: RenderOptions) -> GuardCounts:
    total = Guards()
    for view in views:
        placed = scene.gaussians_at(view)
        total += guards(placed.gaussians, placed.view.camera, settings=options.settings)
    return GuardCounts(asdict(total), total.alarms)


def _summary(
    scene: SceneGraph,
    quality: Mapping[str, Sequence[FrameQuality]],
    latency: Latency,
    guard_counts: GuardCounts,
    run: RunDescription,
    command: str,
    absent: Mapping[str, str],
    geometry: Geometry | None,
) -> RunSummary:
    gaussians, bytes_by_part = scene.counts(), scene.bytes_by_part()
    sizes = {f"{image.width}x{image.height}" for images in quality.values() for image in images}
    return RunSummary(
        run=run,
        evaluated=Evaluation(command, this_machine(), this_source(), latency.device, latency.threads),
        images={split: len(images) for split, images in quality.items()},
        resolutions=tuple(sorted(sizes)),
        quality={split: summarize(images) for split, images in quality.items()},
        by_camera={split: camera_means(images) for split, images in quality.items()},
        definitions=DEFINITIONS,
        absent=dict(absent),
        gaussians=gaussians,
        gaussians_total=sum(gaussians.values()),
        bytes_by_part=bytes_by_part,
        bytes_total=sum(bytes_by_part.values()),
        latency=latency,
        latency_protocol=latency.protocol,
        guards=guard_counts,
        geometry=geometry,
    )


def choose_pictures(quality: Sequence[FrameQuality], count: int) -> list[int]:
    """Indices of the images worth looking at, ascending: half those with most vehicle pixels, half evenly spaced.

    Depends on the data alone, so that two runs on one split show the same images. Of one instant (all cameras share
    it) at most one image counts as a vehicle picture. Gives all indices where ``count`` reaches their number.
    """
    if count >= len(quality):
        return list(range(len(quality)))
    chosen: list[int] = []
    instants: set[int] = set()
    for index in sorted(range(len(quality)), key=lambda index: -quality[index].pixels("vehicle")):
        if len(chosen) == (count + 1) // 2 or quality[index].pixels("vehicle") == 0:
            break
        if quality[index].frame not in instants:
            chosen.append(index)
            instants.add(quality[index].frame)
    remaining = [index for index in range(len(quality)) if index not in chosen]
    wanted = count - len(chosen)
    # The middle of each of ``wanted`` equal stretches; there are at least as many images left, so none repeats.
    spaced = [remaining[(2 * stretch + 1) * len(remaining) // (2 * wanted)] for stretch in range(wanted)]
    return sorted(chosen + spaced)


def _write_pictures(chosen: Sequence[Picture], summary: RunSummary, legend: Legend, folder: Path) -> None:
    """Single PNGs of the chosen images and one sheet of all of them."""
    for kind in KINDS:
        for stale in folder.glob(f"[0-9]*_[0-9]*_{kind}.png"):  # of an earlier evaluation, perhaps on another split
            stale.unlink()
    if not chosen:
        return
    for picture in chosen:
        write_picture(folder, picture)
    views = "held-out" if summary.main_split == HELD_OUT else "training"
    title = (
        f"{summary.run.scene}, {summary.run.label}, seed {summary.run.seed}: "
        f"{summary.mean('psnr_full'):.2f} dB over {summary.images[summary.main_split]} {views} images, "
        f"{summary.gaussians_total:,} Gaussians"
    )
    write_png(folder / "sheet.png", picture_sheet(chosen, title=title, legend=legend))


def _picture(scene: SceneGraph, frame: Frame, options: RenderOptions) -> Picture:
    truth, render = frame.image.cpu().numpy(), _uint8(screen_image(scene, frame, options))
    error = error_picture(render, truth)
    if frame.depth is not None:
        near, beyond = (mask.cpu().numpy() for mask in lidar_masks(frame).values())
        error = draw_lidar_end(error, near, beyond)
    return Picture(*frame.indices, truth, render, error, _uint8(project_centers(scene, frame)))


def _uint8(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return to_uint8(image.detach()).cpu().numpy()
