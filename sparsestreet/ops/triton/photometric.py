"""L1 and D-SSIM against a recorded image of 8 bits: ``sparsestreet.ops.photometric``, around kernels of ``ssim``."""

from functools import partial

import torch
import triton.language as tl
from torch import Tensor

from sparsestreet.ops.triton.launch import jit, launch
from sparsestreet.ops.triton.ssim import similarity_gradient, similarity_sums

LANES = 1024
OPTIONS = {"num_warps": 8}


def compare(
    image: Tensor, recorded: Tensor, white: int, scale: float, share: float, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the value; the image where it counts, the truth in its numbers, and the derivatives of SSIM."""
    seen, truth, value = torch.empty_like(image), torch.empty_like(image), image.new_empty(())
    numbers = image.numel()
    errors = image.new_empty(-(-numbers // LANES))
    launch(compare_colors, numbers, LANES, image, recorded, seen, truth, errors, numbers, white, options=OPTIONS)
    sums, partials = similarity_sums(seen, truth, keep)
    launch(
        add_terms, 1, 1,
        errors, sums, value, len(errors), len(sums), float(scale), share / partials.shape[1:].numel(), float(share),
        LANES=LANES, options=OPTIONS,
    )  # fmt: skip
    return value, seen, truth, partials


def compare_backward(
    image: Tensor,
    recorded: Tensor,
    seen: Tensor,
    truth: Tensor,
    partials: Tensor,
    v_value: Tensor,
    white: int,
    scale: float,
    share: float,
) -> Tensor:
    """Return the gradient of the image."""
    v_image = similarity_gradient(seen, truth, partials, v_value * -share)
    launch(
        compare_colors_backward, image.numel(), LANES,
        image, recorded, truth, v_value, v_image, image.numel(), white, float(scale), options=OPTIONS,
    )  # fmt: skip
    return v_image


@partial(jit, do_not_specialize=["numbers"])
def compare_colors(image, recorded, seen, truth, errors, numbers, white, BLOCK: tl.constexpr):
    """Write what is compared, and each program's sum of errors."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = at < numbers
    x, level = tl.load(image + at, given, 0.0), tl.load(recorded + at, given, 0).to(tl.int32)
    # Rounded as torch rounds.
    y = tl.div_rn(level.to(tl.float32), tl.zeros_like(x) + 255.0)
    x = tl.where((level >= white) & (x > y), y, x)
    tl.store(seen + at, x, given)
    tl.store(truth + at, y, given)
    tl.store(errors + tl.program_id(0), tl.sum(tl.where(given, tl.abs(x - y), 0.0), 0))


@partial(jit, do_not_specialize=["error_count", "sum_count"])
def add_terms(
    errors, sums, value, error_count, sum_count, scale, share, offset, LANES: tl.constexpr, BLOCK: tl.constexpr
):
    """Add the programs' sums in order, and both terms."""
    lane = tl.arange(0, LANES)
    error, similar = tl.zeros((LANES,), tl.float64), tl.zeros((LANES,), tl.float64)
    for first in range(0, error_count, LANES):
        error += tl.load(errors + first + lane, first + lane < error_count, 0.0).to(tl.float64)
    for first in range(0, sum_count, LANES):
        similar += tl.load(sums + first + lane, first + lane < sum_count, 0.0).to(tl.float64)
    tl.store(value, (offset + scale * tl.sum(error, 0) - share * tl.sum(similar, 0)).to(tl.float32))


@partial(jit, do_not_specialize=["numbers"])
def compare_colors_backward(image, recorded, truth, v_value, v_image, numbers, white, scale, BLOCK: tl.constexpr):
    """Add the gradient of L1 to that of SSIM, and take both from numbers that do not count."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = at < numbers
    x, level = tl.load(image + at, given, 0.0), tl.load(recorded + at, given, 0).to(tl.int32)
    y = tl.load(truth + at, given, 0.0)
    pull = tl.load(v_value) * scale
    v = tl.load(v_image + at, given, 0.0) + tl.where(x > y, pull, tl.where(x < y, -pull, 0.0))
    tl.store(v_image + at, tl.where((level >= white) & (x > y), 0.0, v), given)
