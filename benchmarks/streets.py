"""Stored streets on a device: what ``benchmarks.gpu`` splats of them, and frames a second: ``python -m
benchmarks.streets``.
"""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import BenchScene
from sparsestreet.cli.commands.bench import record_file, scene_and_views, street_at
from sparsestreet.cli.commands.options import run_command
from sparsestreet.evaluation.speed import measure_latency
from sparsestreet.geometry.cameras import resized
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.records.summary import FRAME, RASTER, RIG, Latency
from sparsestreet.scene.storage import load_scene, views_of
from sparsestreet.types import Camera, Gaussians, View


def front_streets(scene: Path, enlarge: int = 1, refine: int = 1) -> list[BenchScene]:
    """Return what the camera of the least number sees in the first and middle frame, also in larger images.

    ``scene``: a run's folder, a .street, or a scene.safetensors beside its views.json. ``refine``: as ``refined``.

    Raises FileNotFoundError where there is no scene or there are no views.
    """
    stored, views = scene_and_views(scene)
    front = [view for view in views if view.camera_index == min(view.indices[1] for view in views)]
    chosen = {place: front[place] for place in (0, len(front) // 2)}
    streets = [refined(street_at(scene, stored, view), refine) for view in chosen.values()]
    larger = [replace(street, camera=enlarged(street.camera, enlarge)) for street in streets if enlarge > 1]
    return [*streets, *larger]


def enlarged(camera: Camera, factor: float) -> Camera:
    """Return the camera with an image ``factor`` times as wide and high, in whole pixels."""
    return resized(camera, round(factor * camera.height), round(factor * camera.width))


def refined(street: BenchScene, factor: int, seed: int = 0) -> BenchScene:
    """Return a street whose splats are cut into ``factor`` x ``factor`` each, in an image as much larger.

    The small ones are a ``factor``-th in size and lie where a normal distribution puts them: that of their splat,
    narrowed so that place and size together are as wide as the splat was. Equal for the same seed.
    """
    if factor == 1:
        return street
    gaussians = street.gaussians

    def repeated(field: Tensor) -> Tensor:
        return field.repeat_interleave(factor * factor, 0)

    scales, quaternions = repeated(gaussians.scales), repeated(gaussians.quaternions)
    drawn = torch.randn(scales.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(scales)
    # Variances add: (1 - 1 / factor^2) of places and 1 / factor^2 of sizes.
    offsets = (to_matrix(quaternions) @ ((1 - factor**-2) ** 0.5 * drawn * scales)[..., None])[..., 0]
    small = Gaussians(
        repeated(gaussians.means) + offsets,
        quaternions,
        scales / factor,
        repeated(gaussians.opacities),
        repeated(gaussians.dense_sh()),
        None if gaussians.displacements is None else repeated(gaussians.displacements),
    )
    source = f"{street.source}, refined {factor}x{factor}"
    return BenchScene(street.name, source, small, enlarged(street.camera, factor))


@dataclass(frozen=True)
class FrameRecord:
    """Frames of a stored scene at one size, by the clocks of ``evaluation.speed.measure_latency``."""

    scene: str
    gaussians: dict[str, int]
    width: int
    height: int
    latency: Latency
    memory_peak: float | None
    """MB (10^6 bytes) that torch had allocated on a GPU; None on the CPU."""


def run_frames(
    scenes: Sequence[Path], widths: Sequence[int], file: RecordFile, *, warmup: int = 20, repeats: int = 50
) -> None:
    """Time every scene at every width, the height following from its first view; each record is on disk at once.

    Raises FileNotFoundError where there is no scene or there are no views.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    for scene in scenes:
        stored, recorded = load_scene(scene, device), views_of(scene).all
        for width in widths:
            views = [_as_wide(view, width) for view in recorded]
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats()
            latency = measure_latency(stored.scene, views, stored.options, warmup=warmup, repeats=repeats)
            peak = 1e-6 * torch.cuda.max_memory_allocated() if device.type == "cuda" else None
            camera = views[0].camera
            record = FrameRecord(scene.stem, stored.scene.counts(), camera.width, camera.height, latency, peak)
            file.write("frames", record)
            print(frame_line(record))


def _as_wide(view: View, width: int) -> View:
    return replace(view, camera=enlarged(view.camera, width / view.camera.width))


def frame_line(record: FrameRecord) -> str:
    """Return milliseconds of the three clocks in one line, and frames a second."""
    clocks = record.latency.clocks
    frame, raster, rig = (clocks[name].p50 for name in (FRAME, RASTER, RIG))
    return (
        f"{record.scene}: {sum(record.gaussians.values()):,} Gaussians, {record.width}x{record.height}: frame "
        f"{frame:.3f} ms ({1000 / frame:,.0f} a second), splat alone {raster:.3f}, all cameras {rig:.3f}"
    )


USAGE = """\
python -m benchmarks.streets scenes=A,B [key=value ...]     frames a second of stored scenes

  scenes    runs' folders, .street files, or scene.safetensors beside their views.json
  widths    of the images, pixels (default: 960,1920)
  repeats   renders of each clock (default: 50, what a published number needs)
  out       folder for frames.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class FramesRequest:
    """The script's options. Raises ValueError where they are wrong."""

    scenes: tuple[Path, ...]
    widths: tuple[int, ...] = (960, 1920)
    repeats: int = 50
    out: Path = Path("outputs/bench")

    def __post_init__(self) -> None:
        if not self.scenes or not self.widths or min(self.widths) < 1:
            raise ValueError(f"frames need a scene and a width of at least 1 pixel, got {self.scenes}, {self.widths}")


def main(words: list[str]) -> int:
    """Time as the words say; statuses as in ``run_command``."""
    command = shlex.join(["python", "-m", "benchmarks.streets", *words])

    def act(request: FramesRequest) -> None:
        file = record_file(request.out, "frames", command)
        run_frames(request.scenes, request.widths, file, warmup=min(20, request.repeats), repeats=request.repeats)

    return run_command("frames", USAGE, words, FramesRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
