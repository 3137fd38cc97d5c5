"""Everything that is measured of a finished run, and the files it leaves."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from sparsestreet.evaluation.evaluate import RenderedImage, clamped_render, evaluate_frames
from sparsestreet.evaluation.pictures import KINDS, Legend, Picture, picture_sheet, write_picture, write_png
from sparsestreet.evaluation.provenance import this_machine, this_source
from sparsestreet.evaluation.quality import FrameQuality, summarize
from sparsestreet.evaluation.records import (
    FORMAT,
    GuardCounts,
    Latency,
    RunDescription,
    RunSummary,
    quality_path,
    summary_path,
    write_quality,
    write_summary,
)
from sparsestreet.evaluation.speed import measure_latency
from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.ops import Guards
from sparsestreet.types import Frame

Render = Callable[[Frame], RenderedImage]
Centers = Callable[[Frame], Tensor]
CountGuards = Callable[[Frame], Guards]


def evaluate_run(
    frames: Sequence[Frame],
    *,
    render: Render,
    centers: Centers,
    guards: CountGuards,
    gaussians: dict[str, int],
    bytes_by_part: dict[str, int],
    run: RunDescription,
    out: Path,
    legend: Legend | None = None,
    pictures: int = 4,
    warmup: int = 20,
    repeats: int = 50,
) -> RunSummary:
    """Measure quality, speed and size on held-out frames; write ``out/records`` and ``out/pictures``.

    Args:
        frames: held-out frames; a sequence that loads images when indexed is fine, none is kept.
        render: a frame to its rendering [h, w, 3].
        centers: a frame to a picture of the Gaussians' centers, Float [h, w, 3] in [0, 1].
        guards: a frame to the guards of the op that its render needs.
        gaussians: node class -> number of rows.
        bytes_by_part: part of the scene -> bytes of its parameters.
        run: what identifies the run.
        out: the run's folder.
        legend: node class -> RGB in [0, 255] of its centers, for the picture sheet.
        pictures: how many held-out images become pictures.
        warmup, repeats: of the latency protocol.

    Raises ValueError without frames, or for renders that are not finite or of the wrong size.
    """
    if not frames:
        raise ValueError("there are no held-out frames to evaluate: choose a split that leaves some out")
    quality = list(evaluate_frames(render, frames))
    latency = measure_latency(render, frames, warmup=warmup, repeats=repeats)
    summary = _summary(quality, latency, _guard_counts(guards, frames), gaussians, bytes_by_part, run)
    chosen = [_picture(frames[index], render, centers) for index in choose_pictures(quality, pictures)]
    _write_pictures(chosen, summary, legend, out / "pictures")
    write_quality(quality_path(out), quality)
    write_summary(summary_path(out), summary)
    return summary


def _guard_counts(guards: CountGuards, frames: Sequence[Frame]) -> GuardCounts:
    total = sum((guards(frame) for frame in frames), Guards())
    return GuardCounts(asdict(total), total.alarms)


def _summary(
    quality: Sequence[FrameQuality],
    latency: Latency,
    guards: GuardCounts,
    gaussians: dict[str, int],
    bytes_by_part: dict[str, int],
    run: RunDescription,
) -> RunSummary:
    return RunSummary(
        format=FORMAT,
        run=run,
        images=len(quality),
        resolutions=tuple(sorted({f"{image.width}x{image.height}" for image in quality})),
        quality=summarize(quality),
        definitions=DEFINITIONS,
        gaussians=gaussians,
        gaussians_total=sum(gaussians.values()),
        bytes_by_part=bytes_by_part,
        bytes_total=sum(bytes_by_part.values()),
        latency=latency,
        latency_protocol=latency.protocol,
        machine=this_machine(),
        source=this_source(),
        guards=guards,
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
    for index in sorted(range(len(quality)), key=lambda index: -_vehicle_pixels(quality[index])):
        if len(chosen) == (count + 1) // 2 or _vehicle_pixels(quality[index]) == 0:
            break
        if quality[index].frame not in instants:
            chosen.append(index)
            instants.add(quality[index].frame)
    remaining = [index for index in range(len(quality)) if index not in chosen]
    wanted = count - len(chosen)
    # The middle of each of ``wanted`` equal stretches; there are at least as many images left, so none repeats.
    spaced = [remaining[(2 * stretch + 1) * len(remaining) // (2 * wanted)] for stretch in range(wanted)]
    return sorted(chosen + spaced)


def _vehicle_pixels(image: FrameQuality) -> int:
    return 0 if image.vehicle is None else image.vehicle.pixels


def _write_pictures(chosen: Sequence[Picture], summary: RunSummary, legend: Legend | None, folder: Path) -> None:
    """Single PNGs of the chosen images and one sheet of all of them."""
    for kind in KINDS:
        for stale in folder.glob(f"[0-9]*_[0-9]*_{kind}.png"):  # of an earlier evaluation, perhaps on another split
            stale.unlink()
    if not chosen:
        return
    for picture in chosen:
        write_picture(folder, picture)
    title = (
        f"{summary.run.scene}, {summary.run.method}, seed {summary.run.seed}: "
        f"{summary.quality['psnr_full'].mean:.2f} dB over {summary.images} held-out images, "
        f"{summary.gaussians_total:,} Gaussians"
    )
    write_png(folder / "sheet.png", picture_sheet(chosen, title=title, legend=legend))


def _picture(frame: Frame, render: Render, centers: Centers) -> Picture:
    return Picture(
        frame.frame_index,
        frame.camera_index,
        frame.image.cpu().numpy(),
        _uint8(clamped_render(render, frame)),
        _uint8(centers(frame)),
    )


def _uint8(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
