"""``sparsestreet bench blend``: the stages of the C++ backend, next to vectorized torch and the arithmetic floor."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.bench.records import RecordFile
from sparsestreet.bench.scenes import Size, frustum_camera, frustum_gaussians
from sparsestreet.bench.timing import Cotangent, OpTimes, TimeSpread, TimingBudget, leaves, spread, time_op
from sparsestreet.ops.reference import Splats, on_screen, visible_rows
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.types import Camera, Gaussians

TILE = 16
_BLOCK_ELEMENTS = 1 << 22


@dataclass(frozen=True)
class Block:
    """Tiles that are blended together; entries past the end of a tile's list are not ``listed``."""

    tiles: Int[Tensor, " t"]
    splats: Int[Tensor, "t k"]
    listed: Bool[Tensor, "t k"]


def blend_torch(
    splats: Splats, width: int, height: int, settings: SplatSettings
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Return color (premultiplied) and transmittance; splats must come nearest first."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    image = splats.means.new_zeros(tiles_x * tiles_y, TILE * TILE, 4)
    image[..., 3] = 1
    for block in tile_blocks(splats, tiles_x, tiles_y):
        image[block.tiles] = blend_block(splats, block, tiles_x, settings)
    whole = image.reshape(tiles_y, tiles_x, TILE, TILE, 4).transpose(1, 2).reshape(tiles_y * TILE, tiles_x * TILE, 4)
    whole = whole[:height, :width]
    return whole[..., :3], whole[..., 3]


def blend_gradients(
    splats: Splats, width: int, height: int, settings: SplatSettings, cotangent: Float[Tensor, "h w 3"]
) -> dict[str, Tensor]:
    """Gradients of sum(cotangent * color) with respect to means, cholesky, opacities and colors.

    Each block is differentiated as soon as it is blended, so that only one block's graph is in memory.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    padded = torch.nn.functional.pad(cotangent, (0, 0, 0, tiles_x * TILE - width, 0, tiles_y * TILE - height))
    by_tile = padded.reshape(tiles_y, TILE, tiles_x, TILE, 3).transpose(1, 2).reshape(-1, TILE * TILE, 3)
    leaves = {
        name: getattr(splats, name).detach().requires_grad_() for name in ("means", "cholesky", "opacities", "colors")
    }
    graph = replace(splats, **leaves)
    for block in tile_blocks(splats, tiles_x, tiles_y):
        blend_block(graph, block, tiles_x, settings)[..., :3].backward(by_tile[block.tiles])
    return {name: leaf.grad for name, leaf in leaves.items()}


@torch.no_grad()
def tile_blocks(splats: Splats, tiles_x: int, tiles_y: int) -> Iterator[Block]:
    """Lists the splats of each tile their box touches, and yields tiles of similar length together."""
    first = ((splats.means - splats.half_boxes - 0.5) / TILE).floor().long()
    last = ((splats.means + splats.half_boxes - 0.5) / TILE).floor().long()
    limit = torch.tensor([tiles_x - 1, tiles_y - 1])
    first, last = first.clamp(min=0), torch.minimum(last, limit)
    sides = (last - first + 1).clamp(min=0)
    counts = sides.prod(-1)
    splat = torch.repeat_interleave(counts)
    place = torch.arange(len(splat)) - (counts.cumsum(0) - counts)[splat]
    x, y = first[splat, 0] + place % sides[splat, 0], first[splat, 1] + place // sides[splat, 0]
    tile, order = torch.sort(y * tiles_x + x, stable=True)
    listed = splat[order]
    lengths = torch.bincount(tile, minlength=tiles_x * tiles_y)
    begin = lengths.cumsum(0) - lengths
    by_length = torch.argsort(lengths, descending=True)
    by_length = by_length[lengths[by_length] > 0]
    while len(by_length):
        longest = int(lengths[by_length[0]])
        size = max(1, _BLOCK_ELEMENTS // (longest * TILE * TILE))
        tiles, by_length = by_length[:size], by_length[size:]
        entries = torch.arange(longest)[None]
        valid = entries < lengths[tiles][:, None]
        yield Block(tiles, listed[torch.where(valid, begin[tiles][:, None] + entries, 0)], valid)


def blend_block(splats: Splats, block: Block, tiles_x: int, settings: SplatSettings) -> Float[Tensor, "t 256 4"]:
    """Color and transmittance of the pixels of a block's tiles."""
    weights, transmittance = block_weights(splats, block, tiles_x, settings)
    colors = torch.einsum("tkp,tkc->tpc", weights, splats.colors[block.splats])
    return torch.cat((colors, transmittance[..., None]), -1)


def block_weights(
    splats: Splats, block: Block, tiles_x: int, settings: SplatSettings
) -> tuple[Float[Tensor, "t k 256"], Float[Tensor, "t 256"]]:
    """Blend weight of each splat in each pixel, and the light that passes all of them."""
    inside = torch.arange(TILE * TILE)
    x = (block.tiles % tiles_x * TILE)[:, None] + inside % TILE + 0.5
    y = (block.tiles // tiles_x * TILE)[:, None] + inside // TILE + 0.5
    mean, factor = splats.means[block.splats], splats.cholesky[block.splats]
    dx, dy = x[:, None] - mean[..., :1], y[:, None] - mean[..., 1:]
    a = factor[..., :1] * dx + factor[..., 1:2] * dy
    q = a.square() + (factor[..., 2:] * dy).square()
    touched = (q <= splats.reaches[block.splats][..., None]) & block.listed[..., None]
    raw = splats.opacities[block.splats][..., None] * torch.exp(-0.5 * q)
    alpha = torch.where(touched, raw.clamp(max=settings.alpha_max), 0.0)
    passed = (1 - alpha).cumprod(1)
    before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1]), 1)
    still_open = (before if settings.stop == "inclusive" else passed) > settings.transmittance_min
    alpha = torch.where(still_open, alpha, 0.0)
    return alpha * before, (1 - alpha).prod(1)


FORWARD_FLOPS, BACKWARD_FLOPS = 36, 65
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
            blend_torch(splats, *size, SETTINGS)

    def both() -> None:
        blend_gradients(splats, *size, SETTINGS, cotangent)

    return {"forward": spread(_repeat(forward, budget)), "both": spread(_repeat(both, budget))}


def image_difference(gaussians: Gaussians, camera: Camera) -> Difference:
    """The largest differences; pixels whose difference a tie at the cut-off explains are counted separately."""
    with torch.no_grad():
        image = splat(gaussians, camera, backend="cpu").rgb
        other = blend_torch(_projected(gaussians, camera), camera.width, camera.height, SETTINGS)[0]
    difference = (image - other).abs().amax(-1)
    rest = difference[difference <= _TIE]
    ties = difference.numel() - rest.numel()
    return Difference(difference.numel(), ties, float(difference.max()), float(rest.max()) if len(rest) else 0.0)


def measured_peak(device: torch.device | str = "cpu", size: int = 2048) -> float:
    """float32 operations per second of a matrix product, the best of several."""
    a, b = torch.randn(size, size, device=device), torch.randn(size, size, device=device)

    def product() -> None:
        a @ b
        if a.is_cuda:
            torch.cuda.synchronize(a.device)

    return 2 * size**3 / min(_repeat(product, TimingBudget(repeats=5)))


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
