"""Small frames and runs for the tests of this folder."""

import torch

from sparsestreet.evaluation.quality import MetricSummary
from sparsestreet.evaluation.records import (
    FORMAT,
    GuardCounts,
    Latency,
    Machine,
    RunDescription,
    RunSummary,
    Source,
)
from sparsestreet.types import Camera, Frame


def make_frame(
    index: int = 0,
    camera_index: int = 0,
    size: tuple[int, int] = (9, 12),
    human: torch.Tensor | None = None,
    vehicle: torch.Tensor | None = None,
) -> Frame:
    """A frame with a random image (seeded by frame and camera) and the given masks."""
    generator = torch.Generator().manual_seed(100 * index + camera_index)
    image = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    camera = Camera(torch.eye(4), torch.eye(3), size[1], size[0])
    return Frame(camera, index / 10, index, camera_index, image=image, human=human, vehicle=vehicle)


def make_summary(
    method: str = "plain",
    seed: int = 0,
    psnr: float = 25.0,
    gaussians: dict[str, int] | None = None,
    scene: str = "street",
    vehicle_psnr: float | None = 22.0,
    milliseconds: float = 40.0,
    training_seconds: float | None = 100.0,
    split: str = "every 10th frame from 0",
    device: str = "cpu: test",
    alarms: dict[str, int] | None = None,
) -> RunSummary:
    """A record as a run writes it, with the numbers that a test wants to see in the table."""
    gaussians = gaussians or {"background": 1000, "rigid": 200}
    parts = {name: 4 * 59 * rows for name, rows in gaussians.items()}
    latency = Latency(milliseconds, 1.5 * milliseconds, 2 * milliseconds, 50, 20, 6, device, 2)
    return RunSummary(
        format=FORMAT,
        run=RunDescription(method, scene, seed, split, training_seconds, f"sparsestreet train seed={seed}"),
        images=6,
        resolutions=("64x48",),
        quality={
            "psnr_full": MetricSummary(psnr, 1.0, 6, 0),
            "ssim_uniform7_full": MetricSummary(0.8, 0.1, 6, 0),
            "psnr_vehicle": MetricSummary(vehicle_psnr, None, 0 if vehicle_psnr is None else 1, 0),
        },
        definitions={"psnr_full": "-10 log10(mse)"},
        gaussians=gaussians,
        gaussians_total=sum(gaussians.values()),
        bytes_by_part=parts,
        bytes_total=sum(parts.values()),
        latency=latency,
        latency_protocol=latency.protocol,
        machine=Machine("test", 2, "Linux x86_64", "3.11", "2.13.0"),
        source=Source(None, None),
        guards=GuardCounts({"drawn": 900, "overflowed": 0} | (alarms or {}), alarms or {}),
    )
