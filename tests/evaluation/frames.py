"""Small frames and runs for the tests of this folder."""

from dataclasses import replace
from typing import Any

import torch

from sparsestreet.records.configuration import Setting, config_hash
from sparsestreet.records.geometry import Geometry, RangeErrors
from sparsestreet.records.run import CodeVersion, Machine, Noise, RunDescription
from sparsestreet.records.summary import (
    FRAME,
    HELD_OUT,
    RASTER,
    RIG,
    TRAINING,
    Evaluation,
    FrameQuality,
    GuardCounts,
    Latency,
    MetricSummary,
    Percentiles,
    RegionQuality,
    RunSummary,
)
from sparsestreet.types import Camera, Frame


def make_frame(
    index: int = 0,
    camera_index: int = 0,
    size: tuple[int, int] = (9, 12),
    **known: Any,
) -> Frame:
    """A frame with a random image (seeded by frame and camera) and the given masks and depth."""
    generator = torch.Generator().manual_seed(100 * index + camera_index)
    image = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    intrinsics = torch.tensor([[10.0, 0.0, size[1] / 2], [0.0, 10.0, size[0] / 2], [0.0, 0.0, 1.0]])
    camera = Camera(torch.eye(4), intrinsics, size[1], size[0])
    return Frame(camera, index / 10, index, camera_index, image=image, **known)


MACHINE = Machine("test", 2, "Linux x86_64", "3.11", "2.13.0")
NOISE = Noise(before=0.01, after=0.02, drift=-0.01, load_average=0.5, quiet=True)
CLEAN = CodeVersion("0123456789abcdef", False)


def make_run(
    label: str = "plain",
    seed: int = 0,
    *,
    scene: str = "street",
    split: str = "every 10th frame from 0",
    training_seconds: float | None = 100.0,
    config: dict[str, Setting] | None = None,
    data_hash: str = "0123456789ab",
    device: str = "cpu: test",
    threads: int = 2,
    steps: int = 60,
    caps: dict[str, int] | None = None,
    source: CodeVersion = CLEAN,
    machine: Machine = MACHINE,
    command: str | None = None,
    masks: dict[str, str] | None = None,
    follows: dict[str, Setting] | None = None,
) -> RunDescription:
    """What training writes, with a configuration of a few options beside the given ones."""
    method, _, sparsify = label.partition("+")
    whole = {"seed": seed, "schedule.max_steps": 60, "data.log.width": None, "data.log.settings.seed": seed} | (
        config or {}
    )
    return RunDescription(
        method=method,
        sparsify=sparsify or "none",
        label=label,
        scene=scene,
        seed=seed,
        split=split,
        config=whole,
        follows=follows or {},
        config_hash=config_hash(whole),
        data_hash=data_hash,
        masks=masks or {},
        command=command or f"sparsestreet train seed={seed}",
        device=device,
        threads=threads,
        steps=steps,
        max_steps=60,
        training_seconds=training_seconds,
        noise=NOISE,
        caps=caps or {},
        machine=machine,
        source=source,
    )


def make_image(frame: int, camera: int = 0, *, psnr: float = 20.0, **parts: RegionQuality) -> FrameQuality:
    """The quality of an image of 8x8 pixels, with the regions that are given beside the full one."""
    return FrameQuality(frame, camera, 8, 8, {"full": RegionQuality(64, 0.01, psnr, 0.5)} | parts)


def make_quality(psnr: float, vehicle_psnr: float | None = 22.0) -> dict[str, MetricSummary]:
    return {
        "psnr_full": MetricSummary(psnr, 1.0, 6, 0),
        "ssim_uniform7_full": MetricSummary(0.8, 0.1, 6, 0),
        "psnr_vehicle": MetricSummary(vehicle_psnr, None, 0 if vehicle_psnr is None else 1, 0),
    }


def make_latency(milliseconds: float = 40.0, device: str = "cpu: test", removed: bool = False) -> Latency:
    """A frame takes so long, the op half of it, the cameras of an instant three times as long."""
    clocks = {
        clock: Percentiles(share * milliseconds, 1.5 * share * milliseconds, 2 * share * milliseconds, 50)
        for clock, share in ((RASTER, 0.5), (FRAME, 1.0), (RIG, 3.0))
    }
    return Latency(clocks, clocks if removed else {}, 20, 6, device, 2, NOISE)


def make_summary(
    label: str = "plain",
    seed: int = 0,
    psnr: float | None = 25.0,
    gaussians: dict[str, int] | None = None,
    vehicle_psnr: float | None = 22.0,
    milliseconds: float = 40.0,
    device: str = "cpu: test",
    alarms: dict[str, int] | None = None,
    training_psnr: float | None = None,
    evaluated: Evaluation | None = None,
    cameras: dict[str, dict[str, float | None]] | None = None,
    absent: dict[str, str] | None = None,
    **run: Any,
) -> RunSummary:
    """A record as a run writes it, with the numbers that a test wants to see in the table; ``run`` as in make_run."""
    gaussians = gaussians or {"background": 1000, "rigid": 200}
    parts = {name: 4 * 59 * rows for name, rows in gaussians.items()}
    latency = make_latency(milliseconds, device)
    means = {HELD_OUT: psnr, TRAINING: training_psnr}
    quality = {split: make_quality(mean, vehicle_psnr) for split, mean in means.items() if mean is not None}
    return RunSummary(
        run=make_run(label, seed, **run),
        evaluated=evaluated or Evaluation("sparsestreet evaluate run=x", MACHINE, CLEAN, device, 2),
        images=dict.fromkeys(quality, 6),
        resolutions=("64x48",),
        quality=quality,
        by_camera={
            split: cameras or {"0": {name: one.mean for name, one in metrics.items()}}
            for split, metrics in quality.items()
        },
        definitions={"psnr_full": "-10 log10(mse)"},
        absent=absent or {},
        gaussians=gaussians,
        gaussians_total=sum(gaussians.values()),
        bytes_by_part=parts,
        bytes_total=sum(parts.values()),
        latency=latency,
        latency_protocol=latency.protocol,
        guards=GuardCounts({"drawn": 900, "overflowed": 0} | (alarms or {}), alarms or {}),
    )


def with_ranges(summary: RunSummary, median: float | None, within: float, **groups: RangeErrors) -> RunSummary:
    """The record of a log with lidar: errors of the rays that cameras see, those of all are larger."""
    seen = RangeErrors(900, 0 if median is None else 800, median, median, within, median)
    everything = replace(seen, returns=2000, median=9.0, within=0.1)
    found = {"all": everything, "seen": seen} | groups
    return replace(summary, geometry=Geometry(split=HELD_OUT, sweeps=(5, 15), strides=(2, 2), pixel=0.2, groups=found))


def disturbed(summary: RunSummary, *clocks: str) -> RunSummary:
    """The record with noise while "frames" were timed, or while "training" was."""
    loud = replace(NOISE, before=0.6, quiet=False)
    if "training" in clocks:
        summary = replace(summary, run=replace(summary.run, noise=loud))
    if "frames" in clocks:
        summary = replace(summary, latency=replace(summary.latency, noise=loud))
    return summary
