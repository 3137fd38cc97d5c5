"""Count what the pixels of a view take from each row, and what each row is worth."""

import torch
import triton.language as tl
from torch import Tensor
from torch.nn.functional import pad

from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton import view as record
from sparsestreet.ops.triton.blend import LOOK, LOOK_LENGTH, QUADRANT_PIXELS, blend_one, pixels_of, row_of, whitened
from sparsestreet.ops.triton.gradients import drawn_alpha, inverse_rest, zero_slots
from sparsestreet.ops.triton.launch import constant, jit
from sparsestreet.ops.triton.pixels import blend_view
from sparsestreet.ops.triton.screen import project
from sparsestreet.ops.triton.view import TILE_SIZE, KernelView
from sparsestreet.types import Camera, Gaussians

COUNTER_COUNT = 3
COUNTERS = constant(COUNTER_COUNT)


@jit
def count_tiles_pixels(
    records, pair_rows, pair_slots, begins, ends, order, slots,
    width, height, tiles_x, alpha_max, transmittance_min, EXCLUSIVE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the slots of all pairs of one tile: weight, pixels, dominated pixels."""
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    passed = tl.where(inside, 1.0, 0.0)
    best, best_pair = tl.zeros_like(passed), tl.zeros_like(passed).to(tl.int32) - 1
    begin, end = tl.load(begins + tile), tl.load(ends + tile)
    k = begin
    unfinished = k < end
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        for i in range(k, stop):
            s = record.record_of(records, row_of(tl.load(pair_rows + i)))
            _, _, _, _, exponent = whitened(s, px, py)
            cutoff = tl.load(s + record.CUTOFF)
            alpha = tl.minimum(tl.exp2(exponent), alpha_max)
            weight, passed, _ = blend_one(alpha, exponent >= cutoff, passed, transmittance_min, EXCLUSIVE)
            # Strictly more, so that of equal weights the nearer splat keeps the pixel.
            more = weight > best
            best, best_pair = tl.where(more, weight, best), tl.where(more, i, best_pair)
            o = slots + tl.load(pair_slots + i) * COUNTERS
            tl.store(o, tl.sum(weight))
            tl.store(o + 1, tl.sum((weight > 0).to(tl.float32)))
        k = stop
        unfinished = (k < end) & (tl.max(passed) > transmittance_min)
    for i in range(begin, k):
        tl.store(slots + tl.load(pair_slots + i) * COUNTERS + 2, tl.sum((best_pair == i).to(tl.float32)))
    zero_slots(slots, pair_slots, k, end, COUNTERS)


CHANGE_COUNT, GATHERED_COUNT = 3, 5
CHANGES, GATHERED = constant(CHANGE_COUNT), constant(GATHERED_COUNT)


@jit
def light_of(background, passed, at, inside, CHANNEL: tl.constexpr, BEHIND: tl.constexpr):
    """One channel of the background's light that passes all splats."""
    light = tl.zeros_like(passed)
    if BEHIND:
        light = passed * tl.load(background + 3 * at + CHANNEL, inside, 0.0)
    return light


@jit
def change_of(behind, own, through):
    """The change of the channel without the splat, and the light behind the one before it."""
    return behind * through - own, behind + own


@jit
def remove_from_tiles(
    records, pair_rows, pair_slots, begins, ends, lasts, order, transmittance, background, pixel_weights, slots,
    width, height, tiles_x, alpha_max,
    BEHIND: tl.constexpr, WEIGHTED: tl.constexpr, THREE_WAYS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the slots of all pairs of one tile: largest change, sum of blend weights, sum of squares.

    THREE_WAYS: three sums of squares, by as many layers of ``pixel_weights``."""
    tl.static_assert(BLOCK == 1)
    length: tl.constexpr = GATHERED if THREE_WAYS else CHANGES
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    at = y * width + x
    passed = tl.load(transmittance + at, inside, 0.0)
    red = light_of(background, passed, at, inside, 0, BEHIND)
    green = light_of(background, passed, at, inside, 1, BEHIND)
    blue = light_of(background, passed, at, inside, 2, BEHIND)
    counts = tl.load(pixel_weights + at, inside, 0.0) if WEIGHTED else 1.0
    begin = tl.load(begins + tile)
    last = tl.load(lasts + at, inside, begin)
    latest = tl.max(last)
    if THREE_WAYS:
        layer = width * height
        second = tl.load(pixel_weights + layer + at, inside, 0.0)
        third = tl.load(pixel_weights + 2 * layer + at, inside, 0.0)
    zero_slots(slots, pair_slots, latest, tl.load(ends + tile), length)
    for i in range(latest - begin):
        k = latest - 1 - i
        s = record.record_of(records, row_of(tl.load(pair_rows + k)))
        _, _, _, _, exponent = whitened(s, px, py)
        _, alpha = drawn_alpha(exponent, tl.load(s + record.CUTOFF), k, last, alpha_max)
        inverse = inverse_rest(alpha)
        passed *= inverse
        weight, through = alpha * passed, alpha * inverse
        of_red, red = change_of(red, weight * tl.load(s + record.COLOR), through)
        of_green, green = change_of(green, weight * tl.load(s + record.COLOR + 1), through)
        of_blue, blue = change_of(blue, weight * tl.load(s + record.COLOR + 2), through)
        largest = tl.maximum(tl.maximum(tl.abs(of_red), tl.abs(of_green)), tl.abs(of_blue))
        squared = of_red * of_red + of_green * of_green + of_blue * of_blue
        o = slots + tl.load(pair_slots + k) * length
        tl.store(o, tl.max(largest))
        tl.store(o + 1, tl.sum(weight))
        tl.store(o + 2, tl.sum(counts * squared))
        if THREE_WAYS:
            tl.store(o + 3, tl.sum(second * squared))
            tl.store(o + 4, tl.sum(third * squared))


@torch.no_grad()
def count_work(gaussians: Gaussians, camera: Camera, settings: SplatSettings) -> tuple[int, int]:
    """(splat, tile) pairs of one view and (splat, pixel) samples that its forward pass computes.

    A tile is counted up to the block of 32 pairs in which its last pixel is still open, and for each pair the quadrants
    that it touches. Long tiles count as unsplit, without the second computation of the light through their parts.
    """
    view = KernelView.of(camera, settings)
    screen = project(gaussians, view)
    lists = screen.lists
    counts, seen = lists.ends - lists.begins, _last_of_tiles(blend_view(screen, view, lasts=True).ends.lasts, view)
    seen = torch.where(counts > 0, seen - lists.begins, 0)
    walked = torch.minimum(-(-seen // LOOK_LENGTH) * LOOK_LENGTH, counts)
    touched = (lists.quadrants_of_pairs[:, None] >> torch.arange(4, device=counts.device) & 1).sum(1)
    before = torch.nn.functional.pad(touched.cumsum(0), (1, 0))
    quadrants = before[(lists.begins + walked).long()] - before[lists.begins.long()]
    return len(lists.slots), int(quadrants.sum()) * QUADRANT_PIXELS


def _last_of_tiles(lasts: Tensor, view: KernelView) -> Tensor:
    columns, rows = view.tiles
    padded = pad(lasts, (0, columns * TILE_SIZE - lasts.shape[1], 0, rows * TILE_SIZE - lasts.shape[0]))
    return padded.view(rows, TILE_SIZE, columns, TILE_SIZE).amax((1, 3)).flatten()
