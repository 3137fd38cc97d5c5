"""Weighted means over pixels and what their gradients need: ``sparsestreet.ops.pixel_losses``. Sums are added in order,
by a second kernel, so that two runs agree to the last bit."""

from functools import partial

import torch
import triton.language as tl
from torch import Tensor

from sparsestreet.ops.triton.launch import constant, jit, launch

LANES = 1024
OPTIONS = {"num_warps": 8}
_SKY, _INVERSE_DEPTH = constant(2), constant(1)


def mean_of_(
    predicted: Tensor,
    truth: Tensor,
    kind: int,
    numbers: tuple[float, float, float],
    weight: float,
    slopes: Tensor | None,
    mean: Tensor,
    share: Tensor,
) -> None:
    """Write the mean, the share of each pixel's derivative in that of the mean, and the derivatives.

    Kinds and their numbers are those of the op."""
    pixels = predicted.numel()
    programs = -(-pixels // LANES)
    sums = predicted.new_empty(2, programs)
    truth = truth.view(torch.uint8) if truth.dtype == torch.bool else truth
    launch(
        sum_pixels, pixels, LANES,
        predicted, truth, predicted if slopes is None else slopes, sums, pixels, programs, *map(float, numbers),
        KIND=kind, SLOPES=slopes is not None, options=OPTIONS,
    )  # fmt: skip
    launch(add_sums, 1, 1, sums, mean, share, programs, float(weight), LANES=LANES, options=OPTIONS)


@jit
def sky_term(alpha, sky, eps, floor):
    """Return the number of each pixel and its derivative."""
    right = tl.where(sky != 0, 1 - alpha, alpha)
    # So that NaN remains.
    right = tl.where(right < floor, floor, right)
    slope = 1 / (right + eps)
    return -tl.log((right + eps) / (1 + eps)), tl.where(sky != 0, slope, -slope)


@jit
def depth_term(rendered, measured, nearest, farthest, nearest_rendered, INVERSE: tl.constexpr):
    """Return the number of each pixel, its derivative, and whether it counts."""
    valid = (measured > nearest) & (measured < farthest) & (rendered > nearest_rendered)
    rendered, measured = tl.where(valid, rendered, 1.0), tl.where(valid, measured, 1.0)
    slope = tl.zeros_like(rendered) + 1
    error = rendered - measured
    if INVERSE:
        error, slope = 1 / rendered - 1 / measured, -1 / (rendered * rendered)
    return tl.abs(error), tl.where(error > 0, slope, tl.where(error < 0, -slope, 0.0)), valid


@partial(jit, do_not_specialize=["pixels", "programs"])
def sum_pixels(
    predicted, truth, slopes, sums, pixels, programs, first, second, third,
    KIND: tl.constexpr, SLOPES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Sums of each program's numbers, and how many counted, in ``sums`` [2, programs]."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = at < pixels
    number, other = tl.load(predicted + at, given, 1.0), tl.load(truth + at, given, 0)
    if KIND == _SKY:
        value, slope = sky_term(number, other, first, second)
        counts = given
    else:
        value, slope, counts = depth_term(number, other, first, second, third, KIND == _INVERSE_DEPTH)
        counts = counts & given
    if SLOPES:
        tl.store(slopes + at, slope, given)
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(counts, value, 0.0), 0))
    tl.store(sums + programs + tl.program_id(0), tl.sum(counts.to(tl.float32), 0))


@partial(jit, do_not_specialize=["programs"])
def add_sums(sums, mean, share, programs, weight, LANES: tl.constexpr, BLOCK: tl.constexpr):
    """The weighted mean, and the weight over the number that counted."""
    lane = tl.arange(0, LANES)
    total, count = tl.zeros((LANES,), tl.float64), tl.zeros((LANES,), tl.float64)
    for first in range(0, programs, LANES):
        given = first + lane < programs
        total += tl.load(sums + first + lane, given, 0.0).to(tl.float64)
        count += tl.load(sums + programs + first + lane, given, 0.0).to(tl.float64)
    each = weight / tl.maximum(tl.sum(count, 0), 1.0)
    tl.store(share, each.to(tl.float32))
    tl.store(mean, (each * tl.sum(total, 0)).to(tl.float32))
