"""What renderings take as CUDA graphs, and whether they keep their bits: gpu_capture.py OUT [--dry-run].

Each case is rendered as ever and as a graph in turn, from cameras that move, compared bit for bit and timed; one JSON
object a line in OUT. What a case refuses is its answer, not an error. --dry-run: tiny and without a graph, in Triton's
interpreter (TRITON_INTERPRET=1).
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from sparsestreet.bench.scenes import frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import GROUPS, Cotangent, leaves
from sparsestreet.geometry.cameras import moved
from sparsestreet.ops import splat
from sparsestreet.ops.triton.graphs import COUNTS
from sparsestreet.types import Camera, Gaussians

Case = Callable[[Camera, bool], tuple[Tensor, ...]]
"""Work on a device, from a camera, as a graph or not; what it answers."""
REPEATS = 50
SIZES = ((1_500_000, 1920, 1280), (100_000, 960, 640))


@dataclass(frozen=True)
class Answer:
    """What became of a case. Times are milliseconds: of the clock on the wall, to the end of the device's work."""

    case: str
    rows: int
    width: int
    height: int
    refused: str | None = None
    """Why there was no graph, in one line."""
    equal: bool | None = None
    """Whether graphs write the bits that are written without; without a device: whether what is drawn twice is."""
    ms: float | None = None
    replayed_ms: float | None = None
    replays: int = 0
    peak_mb: float | None = None
    """10^6 bytes that torch had allocated at most, graphs included."""


def cases(gaussians: Gaussians, cotangent: Cotangent) -> dict[str, Case]:
    """The op without and with gradients."""
    fields = tuple(getattr(gaussians, name) for name in GROUPS)

    def forward(camera: Camera, replay: bool) -> tuple[Tensor, ...]:
        with torch.no_grad():
            rendering = splat(gaussians, camera, backend="triton", replay=replay)
        return rendering.rgb, rendering.alpha, rendering.depth, rendering.radii

    def both(camera: Camera, replay: bool) -> tuple[Tensor, ...]:
        rendering = splat(gaussians, camera, backend="triton", replay=replay)
        outputs = (rendering.rgb, rendering.alpha)
        gradients = torch.autograd.grad(outputs, fields, (cotangent.rgb, cotangent.alpha))
        return *(output.detach() for output in outputs), *gradients

    return {"forward": forward, "forward and backward": both}


def probed(run: Case, blank: Answer, cameras: list[Camera], replay: bool) -> Answer:
    """What becomes of one case; the first renderings of each kind compile, guess and capture."""
    seconds: dict[bool, list[float]] = {False: [], True: []}
    equal, before = True, COUNTS["replayed"]
    try:
        for camera in [*cameras[:4], *cameras]:
            answers = [timed(run, camera, kind and replay, seconds[kind]) for kind in (False, True)]
            pairs = zip(*answers, strict=True)
            equal = equal and all(torch.equal(one.view(torch.int32), other.view(torch.int32)) for one, other in pairs)
    except Exception as error:  # what a device refuses is what is asked
        lines = str(error).strip().splitlines()
        return Answer(**asdict(blank) | {"refused": f"{type(error).__name__}: {lines[0] if lines else 'no message'}"})
    whole = {"equal": equal, "replays": COUNTS["replayed"] - before}
    if replay:
        ms, replayed = (round(1000 * median(seconds[kind][4:]), 3) for kind in (False, True))
        whole |= {"ms": ms, "replayed_ms": replayed, "peak_mb": round(torch.cuda.max_memory_allocated() / 1e6)}
    return Answer(**asdict(blank) | whole)


def timed(run: Case, camera: Camera, replay: bool, seconds: list[float]) -> tuple[Tensor, ...]:
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    wait()
    start = time.perf_counter()
    answer = run(camera, replay)
    wait()
    seconds.append(time.perf_counter() - start)
    return tuple(one.contiguous() for one in answer)


def main(out: Path, sizes: tuple[tuple[int, int, int], ...], repeats: int) -> None:
    """Probe every case at every size; each answer is on disk before the next."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    steps = torch.linspace(0.0, 0.5, repeats, dtype=torch.float64)
    with out.open("w", encoding="utf-8") as file:
        for rows, width, height in sizes:
            camera = frustum_camera(width, height)
            gaussians = leaves(frustum_gaussians(rows, camera, sigma_pixels=2.0, terms=16), torch.float32, device)
            cameras = [moved(camera, torch.stack((step, 0 * step, 0 * step))) for step in steps]
            for name, run in cases(gaussians, Cotangent.of(camera, gaussians.means)).items():
                answer = probed(run, Answer(name, rows, width, height), cameras, device == "cuda")
                file.write(json.dumps(asdict(answer)) + "\n")
                file.flush()
                times = f"{answer.ms} ms, {answer.replayed_ms} as {answer.replays} graphs; equal {answer.equal}"
                print(f"{name}, {rows:,} rows, {width}x{height}: {answer.refused or times}")


if __name__ == "__main__":
    path, *dry = sys.argv[1:]
    main(Path(path), *((((3, 16, 16),), 1) if dry == ["--dry-run"] else (SIZES, REPEATS)))
