"""Times the blend of the C++ backend against vectorised torch on the same splats, in the same run.

python -m sparsestreet.ops.bench.blend [--rows 100000] [--size 640x384] [--csv benchmarks/blend.csv]
"""

import argparse
import csv
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from sparsestreet.ops.bench import torch_tiles
from sparsestreet.ops.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.ops.cpu.workspace import idle_workspaces
from sparsestreet.ops.reference import Splats, on_screen, visible_rows
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.types import Camera, Gaussians

FORWARD_FLOPS, BACKWARD_FLOPS = 30, 57
"""Per (splat, pixel) sample: the arithmetic of one colour blend and of its gradient."""
SETTINGS = SplatSettings()
TRAINING_ROWS = (20_000, 60_000)
"""Rows of the small street; its images are 320x192. There the cost of a call counts as well as that of the loops."""


@dataclass(frozen=True)
class Timing:
    """Seconds of repeated runs."""

    name: str
    seconds: list[float]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    def line(self) -> str:
        low, high = min(self.seconds), max(self.seconds)
        return f"{self.name:<42}{1e3 * self.median:10.2f}  [{1e3 * low:.2f}, {1e3 * high:.2f}]"


def main() -> None:
    """Print the table and, if asked to, append it to a CSV."""
    arguments = _arguments()
    width, height = (int(side) for side in arguments.size.split("x"))
    torch.set_num_threads(arguments.threads)
    camera = frustum_camera(width, height)
    gaussians = frustum_gaussians(arguments.rows, camera, sigma_pixels=2.0, terms=16)
    cotangent = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(1))

    cpu, samples, pairs = time_cpu(gaussians, camera, cotangent, arguments.repeats)
    peer = time_torch(gaussians, camera, cotangent, arguments.peer_repeats)
    peak = measured_peak()
    floors = [Timing(name, [flops * samples / peak]) for name, flops in _floors()]
    ratio = peer[-1].median / (cpu["bin"].median + cpu["blend"].median + cpu["blend_backward"].median)

    print(f"{arguments.rows} splats, {width}x{height}, {arguments.threads} threads, {_machine()}")
    print(f"{pairs} (splat, tile) pairs, {samples / 1e6:.1f} M samples, peak {peak / 1e9:.0f} GFLOP/s (float32 matmul)")
    print(f"{'milliseconds':<42}{'median':>10}  [min, max]")
    rows = [*cpu.values(), *peer, *floors]
    for timing in rows:
        print(timing.line())
    print(f"blend forward + backward, torch over C++: {ratio:.0f} times")
    print(image_difference(gaussians, camera))
    for count in TRAINING_ROWS:
        rows += _training_step(count, arguments.repeats)
    if arguments.csv is not None:
        _append(arguments.csv, rows, samples, pairs)


def time_cpu(
    gaussians: Gaussians, camera: Camera, cotangent: torch.Tensor, repeats: int
) -> tuple[dict[str, Timing], int, int]:
    """Stage times and whole-op times; the number of samples and of (splat, tile) pairs."""
    leaves = [
        getattr(gaussians, name).requires_grad_() for name in ("means", "quaternions", "scales", "opacities", "sh")
    ]
    seconds: dict[str, list[float]] = {}
    for repeat in range(repeats + 2):
        start = time.perf_counter()
        rendering = splat(gaussians, camera, backend="cpu")
        forward = time.perf_counter()
        rendering.rgb.backward(cotangent)
        end = time.perf_counter()
        del rendering
        for leaf in leaves:
            leaf.grad = None
        stages = idle_workspaces()[-1].stage_seconds()
        if repeat >= 2:  # after the buffers have grown
            whole = {"whole op, forward": forward - start, "whole op, backward": end - forward}
            for name, value in (stages | whole).items():
                seconds.setdefault(name, []).append(value)
    del seconds["count"]
    workspace = idle_workspaces()[-1]
    timings = {name: Timing(f"C++ {name}", values) for name, values in seconds.items()}
    return timings, workspace.sample_count(), workspace.pair_count()


def time_torch(gaussians: Gaussians, camera: Camera, cotangent: torch.Tensor, repeats: int) -> list[Timing]:
    """Forward alone, and forward + backward, each with the listing of tiles, of splats already on the screen."""
    splats = _projected(gaussians, camera)
    size = (camera.width, camera.height)

    def forward() -> None:
        with torch.no_grad():
            torch_tiles.blend(splats, *size, SETTINGS)

    def both() -> None:
        torch_tiles.blend_gradients(splats, *size, SETTINGS, cotangent)

    return [
        Timing("torch tiles forward", _repeat(forward, repeats)),
        Timing("torch tiles both", _repeat(both, repeats)),
    ]


def _training_step(rows: int, repeats: int) -> list[Timing]:
    """Times and prints the whole op, projection to image and back to the parameters, at a size of training."""
    camera = frustum_camera(320, 192)
    gaussians = frustum_gaussians(rows, camera, sigma_pixels=2.0, terms=16)
    timings, samples, pairs = time_cpu(gaussians, camera, torch.randn(192, 320, 3), repeats)
    print(f"{rows} splats, 320x192: {pairs} pairs, {samples / 1e6:.1f} M samples")
    named = [Timing(f"{timing.name}, {rows // 1000}k 320x192", timing.seconds) for timing in timings.values()]
    for timing in named:
        print(timing.line())
    return named


def image_difference(gaussians: Gaussians, camera: Camera) -> str:
    """C++ against vectorised torch; pixels in which a splat lies within rounding of the cut-off are named apart."""
    with torch.no_grad():
        image = splat(gaussians, camera, backend="cpu").rgb
        other = torch_tiles.blend(_projected(gaussians, camera), camera.width, camera.height, SETTINGS)[0]
    difference = (image - other).abs().amax(-1)
    ties = int((difference > 1e-5).sum())
    rest = float(difference[difference <= 1e-5].max())
    most = float(difference.max())
    return f"image difference: {rest:.1e}, except {ties} of {difference.numel()} pixels (up to {most:.1e})"


def measured_peak(size: int = 2048, repeats: int = 5) -> float:
    """float32 operations per second of a matrix product, the best of several."""
    a, b = torch.randn(size, size), torch.randn(size, size)
    return 2 * size**3 / min(_repeat(lambda: a @ b, repeats))


def _floors() -> tuple[tuple[str, int], tuple[str, int]]:
    return ("arithmetic floor, forward", FORWARD_FLOPS), ("arithmetic floor, backward", BACKWARD_FLOPS)


def _projected(gaussians: Gaussians, camera: Camera) -> Splats:
    with torch.no_grad():
        return on_screen(gaussians, visible_rows(gaussians, camera, SETTINGS), camera, SETTINGS)


def _repeat(call: Callable[[], object], repeats: int) -> list[float]:
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return seconds


def _machine() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return answer.stdout.strip() or "unknown"


def _append(path: Path, rows: list[Timing], samples: int, pairs: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(
                ("machine", "commit", "command", "pairs", "samples", "what", "median_ms", "min_ms", "max_ms")
            )
        command = "python -m sparsestreet.ops.bench.blend " + " ".join(sys.argv[1:])
        for row in rows:
            times = (f"{1e3 * value:.3f}" for value in (row.median, min(row.seconds), max(row.seconds)))
            writer.writerow((_machine(), _commit(), command, pairs, samples, row.name, *times))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=100_000, help="number of splats")
    parser.add_argument("--size", default="640x384", help="image, WIDTHxHEIGHT")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--peer-repeats", type=int, default=3, help="repeats of the torch version, seconds each")
    parser.add_argument("--csv", type=Path, help="append the table to this file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
