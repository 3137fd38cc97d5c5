"""What of a step can be captured in a CUDA graph, and what a replay takes: gpu_capture.py OUT [--dry-run].

The op waits once a rendering, for the numbers of rows and pairs; a graph cannot. So these are read beforehand and put
in their place, as a graph of fixed room would have it. Each case is run as ever, captured, replayed over spoiled
outputs, compared bit for bit and timed; one JSON object a line in OUT. What a case refuses is its answer, not an error.
--dry-run: tiny, without a graph, in Triton's interpreter (TRITON_INTERPRET=1).
"""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from sparsestreet.bench.scenes import frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import GROUPS, Cotangent, leaves
from sparsestreet.host_copy import HostCopy
from sparsestreet.ops import splat
from sparsestreet.ops.triton import screen
from sparsestreet.ops.triton.parts import Sizes
from sparsestreet.types import Camera, Gaussians

Case = Callable[[], tuple[Tensor, ...]]
"""Work on a device; what it answers."""
REPEATS = 50
SIZES = ((1_500_000, 1920, 1280), (100_000, 960, 640))


@dataclass(frozen=True)
class Answer:
    """What became of a case. Times are milliseconds of the device, from one event to the next, launch gaps included."""

    case: str
    rows: int
    width: int
    height: int
    captured: bool
    refused: str | None
    """Why it was not captured, in one line."""
    equal: bool | None
    """Whether a replay, and a run that does not wait, write the bits of a run that waits."""
    eager_ms: float | None
    replay_ms: float | None


@contextmanager
def without_waiting(gaussians: Gaussians, camera: Camera) -> Iterator[None]:
    """Inside, the op takes the sizes of this view as they were before, and asks the device for none."""
    found: list[tuple[int, int]] = []
    read, copy_to_host = screen.read, screen.copy_to_host

    def noted(sizes: Sizes, *others: object) -> None:
        read(sizes, *others)
        found.append((sizes.pairs, sizes.rows))

    def known(sizes: Sizes, *_: object) -> None:
        sizes.pairs, sizes.rows = found[-1]

    try:
        screen.read = noted
        for _ in range(2):  # the first knows no room, so it waits in between
            splat(gaussians, camera, backend="triton")
        screen.read, screen.copy_to_host = known, lambda values: HostCopy(values, None)
        yield
    finally:
        screen.read, screen.copy_to_host = read, copy_to_host


def cases(gaussians: Gaussians, camera: Camera) -> dict[str, Case]:
    """Sorts of the lists' kinds, as many as there are rows; the op without and with gradients."""
    cotangent = Cotangent.of(camera, gaussians.means)
    keys = gaussians.means[:, 2].detach().contiguous().view(torch.int32)
    tiles = (keys % 9_600).to(torch.int16)
    fields = tuple(getattr(gaussians, name) for name in GROUPS)

    def forward() -> tuple[Tensor, ...]:
        with torch.no_grad():
            rendering = splat(gaussians, camera, backend="triton")
        return rendering.rgb, rendering.alpha, rendering.depth, rendering.radii

    def both() -> tuple[Tensor, ...]:
        rendering = splat(gaussians, camera, backend="triton")
        outputs = (rendering.rgb, rendering.alpha)
        gradients = torch.autograd.grad(outputs, fields, (cotangent.rgb, cotangent.alpha))
        return *(output.detach() for output in outputs), *gradients

    return {
        "sort of int32": lambda: tuple(torch.sort(keys, stable=True)),
        "sort of int16": lambda: tuple(torch.sort(tiles, stable=True)),
        "forward": forward,
        "forward and backward": both,
    }


def milliseconds(run: Callable[[], object]) -> float:
    """Median of the device's time, each repeat by itself."""
    taken = []
    for _ in range(REPEATS):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        run()
        end.record()
        end.synchronize()
        taken.append(start.elapsed_time(end))
    return median(taken)


def bits(values: tuple[Tensor, ...]) -> list[Tensor]:
    """Copies as whole numbers, so that a NaN equals itself."""
    kinds = {4: torch.int32, 2: torch.int16, 8: torch.int64}
    return [value.detach().clone().contiguous().view(kinds[value.element_size()]) for value in values]


def same(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def captured(run: Case) -> tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...]]:
    """The graph of ``run`` and where it writes. Tables of a stream are made before it is captured."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            run()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        outputs = run()
    return graph, outputs


def probed(name: str, run: Case, blank: Answer, gaussians: Gaussians, camera: Camera) -> Answer:
    """What becomes of one case."""
    waits, entries = bits(run()), asdict(blank) | {"case": name}
    try:
        with without_waiting(gaussians, camera):
            alike = same(waits, bits(run()))
            if not gaussians.means.is_cuda:
                return Answer(**entries | {"equal": alike})
            entries |= {"eager_ms": milliseconds(run)}
            graph, outputs = captured(run)
            for output in outputs:
                output.detach().fill_(-1)
            graph.replay()
            torch.cuda.synchronize()
            equal = alike and same(waits, bits(outputs))
            return Answer(**entries | {"captured": True, "equal": equal, "replay_ms": milliseconds(graph.replay)})
    except Exception as error:  # what a device refuses is what is asked
        lines = str(error).strip().splitlines()
        return Answer(**entries | {"refused": f"{type(error).__name__}: {lines[0] if lines else 'no message'}"})


def main(out: Path, sizes: tuple[tuple[int, int, int], ...]) -> None:
    """Probe every case at every size; each answer is on disk before the next."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with out.open("w", encoding="utf-8") as file:
        for rows, width, height in sizes:
            camera = frustum_camera(width, height)
            gaussians = leaves(frustum_gaussians(rows, camera, sigma_pixels=2.0, terms=16), torch.float32, device)
            blank = Answer("", rows, width, height, False, None, None, None, None)
            for name, run in cases(gaussians, camera).items():
                answer = probed(name, run, blank, gaussians, camera)
                file.write(json.dumps(asdict(answer)) + "\n")
                file.flush()
                times = f"{answer.eager_ms} ms, replayed {answer.replay_ms} ms; equal {answer.equal}"
                print(f"{name}, {rows:,} rows, {width}x{height}: {answer.refused or times}")


if __name__ == "__main__":
    path, *dry = sys.argv[1:]
    main(Path(path), ((3, 16, 16),) if dry == ["--dry-run"] else SIZES)
