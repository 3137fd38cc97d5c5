"""``sparsestreet bench blend``: the stages of the C++ backend, next to vectorized torch and the arithmetic floor."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from sparsestreet.bench import torch_tiles
from sparsestreet.bench.frustum import frustum_camera, frustum_gaussians
from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import Size
from sparsestreet.bench.timing import Cotangent, OpTimes, TimeSpread, TimingBudget, leaves, spread, time_op
from sparsestreet.ops.reference import Splats, on_screen, visible_rows
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.types import Camera, Gaussians

FORWARD_FLOPS, BACKWARD_FLOPS = 30, 57
"""Operations per (splat, pixel) sample of one color blend, and of its gradient."""
SETTINGS = SplatSettings()
MAIN = Size(640, 384, 100_000)
TRAINING = (Size(320, 192, 20_000), Size(320, 192, 60_000))
"""Sizes of training, where the cost of a call counts as well as that of the loops."""
_TIE = 1e-5
"""Larger differences come from a splat within rounding of the cut-off, which only one of the two blends."""


@dataclass(frozen=True)
class Difference:
    """C++ against vectorized torch: the largest differences over the pixels."""

    pixels: int
    ties: int
    """Pixels in which a splat lies within rounding of the cut-off."""
    largest: float
    largest_without_ties: float


@dataclass(frozen=True)
class BlendRecord:
    """One size; times are milliseconds."""

    rows: int
    width: int
    height: int
    times: OpTimes
    peer: dict[str, TimeSpread] | None
    """Vectorized torch on splats that are already on the screen: ``forward``, and ``both`` with backward."""
    peak_gflops: float | None
    """float32 operations of a matrix product in the same run."""
    floor_ms: dict[str, float] | None
    """Samples x operations over the peak."""
    difference: Difference | None


def run_blend(
    size: Size,
    training: Sequence[Size],
    budget: TimingBudget,
    peer_budget: TimingBudget,
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> None:
    """Times one size together with the peer, then the sizes of training without it."""
    for record in (_with_peer(size, budget, peer_budget), *(_alone(other, budget) for other in training)):
        file.write("blend", record)
        for line in lines(record):
            say(line)


def _alone(size: Size, budget: TimingBudget) -> BlendRecord:
    gaussians, camera = _scene(size)
    times = time_op(leaves(gaussians, torch.float32), camera, SETTINGS, "cpu", budget)
    return BlendRecord(size.rows, size.width, size.height, times, None, None, None, None)


def _with_peer(size: Size, budget: TimingBudget, peer_budget: TimingBudget) -> BlendRecord:
    alone = _alone(size, budget)
    gaussians, camera = _scene(size)
    peak = measured_peak()
    flops = {"blend": FORWARD_FLOPS, "blend_backward": BACKWARD_FLOPS}
    return replace(
        alone,
        peer=time_torch(gaussians, camera, peer_budget),
        peak_gflops=1e-9 * peak,
        floor_ms={stage: 1e3 * count * (alone.times.samples or 0) / peak for stage, count in flops.items()},
        difference=image_difference(gaussians, camera),
    )


def _scene(size: Size) -> tuple[Gaussians, Camera]:
    camera = frustum_camera(size.width, size.height)
    return frustum_gaussians(size.rows, camera, sigma_pixels=2.0, terms=16), camera


def time_torch(gaussians: Gaussians, camera: Camera, budget: TimingBudget) -> dict[str, TimeSpread]:
    """Times forward, and forward + backward, of splats already on the screen; both include the listing of tiles."""
    splats, size = _projected(gaussians, camera), (camera.width, camera.height)
    cotangent = Cotangent.of(camera, gaussians.means).rgb

    def forward() -> None:
        with torch.no_grad():
            torch_tiles.blend(splats, *size, SETTINGS)

    def both() -> None:
        torch_tiles.blend_gradients(splats, *size, SETTINGS, cotangent)

    return {"forward": spread(_repeat(forward, budget)), "both": spread(_repeat(both, budget))}


def image_difference(gaussians: Gaussians, camera: Camera) -> Difference:
    """The largest differences; pixels whose difference a tie at the cut-off explains are counted separately."""
    with torch.no_grad():
        image = splat(gaussians, camera, backend="cpu").rgb
        other = torch_tiles.blend(_projected(gaussians, camera), camera.width, camera.height, SETTINGS)[0]
    difference = (image - other).abs().amax(-1)
    rest = difference[difference <= _TIE]
    ties = difference.numel() - rest.numel()
    return Difference(difference.numel(), ties, float(difference.max()), float(rest.max()) if len(rest) else 0.0)


def measured_peak(size: int = 2048) -> float:
    """float32 operations per second of a matrix product, the best of several."""
    a, b = torch.randn(size, size), torch.randn(size, size)
    return 2 * size**3 / min(_repeat(lambda: a @ b, TimingBudget(repeats=5)))


def lines(record: BlendRecord) -> list[str]:
    """The record as a table for the terminal."""
    times = record.times
    text = [
        f"\n{record.rows} splats, {record.width}x{record.height}: {times.pairs} (splat, tile) pairs, "
        f"{(times.samples or 0) / 1e6:.1f} M samples"
    ]
    for name, value in times.stages.items():
        floor = (record.floor_ms or {}).get(name)
        text.append(f"  {name:<24}{value}" + (f", {value.median / floor:.1f} x its floor" if floor else ""))
    if record.peer is None or record.difference is None:
        return text
    blend = sum(times.stages[name].median for name in ("bin", "blend", "blend_backward"))
    gap = record.difference
    return [
        *text,
        *(f"  torch tiles, {name:<11}{value}" for name, value in record.peer.items()),
        f"  peak {record.peak_gflops:.0f} GFLOP/s (float32 matrix product)",
        f"  blend forward + backward, torch over C++: {record.peer['both'].median / blend:.0f} times",
        f"  image difference {gap.largest_without_ties:.1e}, except {gap.ties} of {gap.pixels} pixels at the cut-off "
        f"(up to {gap.largest:.1e})",
    ]


def _projected(gaussians: Gaussians, camera: Camera) -> Splats:
    with torch.no_grad():
        return on_screen(gaussians, visible_rows(gaussians, camera, SETTINGS), camera, SETTINGS)


def _repeat(call: Callable[[], object], budget: TimingBudget) -> list[float]:
    seconds: list[float] = []

    def run() -> None:
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)

    budget.warm_up(run)
    seconds.clear()
    budget.runs(run)
    return seconds
