"""What one view adds to the statistics of rows, one lane a row: ``sparsestreet.ops.statistics``."""

from functools import partial

import triton.language as tl
from torch import Tensor

from sparsestreet.ops.triton.launch import jit, launch

LANES = 128


def add_view_(
    statistics: tuple[Tensor, Tensor, Tensor] | None,
    screen_gradient: Tensor,
    radii: Tensor,
    size: tuple[int, int],
    visits_all: bool,
    watched: tuple[Tensor, Tensor] | None,
) -> None:
    """Add to sums of norms, visits and largest radii, and to the sum of a watched column; None: not to these.

    Tensors are contiguous, of float32 but for the visits.
    """
    # What is not there is not touched: any tensor stands for it.
    given = (*(statistics or (radii,) * 3), *(watched or (radii,) * 2))
    launch(
        add_rows, len(radii), LANES,
        screen_gradient, radii, *given, len(radii), *(side / 2 for side in size), float(max(size)),
        STATISTICS=statistics is not None, WATCHED=watched is not None, VISITS_ALL=visits_all,
    )  # fmt: skip


@partial(jit, do_not_specialize=["rows"])
def add_rows(
    screen_gradient, radii, gradient_sum, visits, largest_screen, watched_sum, watched_gradient,
    rows, half_width, half_height, longer,
    STATISTICS: tl.constexpr, WATCHED: tl.constexpr, VISITS_ALL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """BLOCK rows, each with the two numbers of its gradient on screen, and its radius."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
    x = tl.load(screen_gradient + 2 * row, given, 0.0) * half_width
    y = tl.load(screen_gradient + 2 * row + 1, given, 0.0) * half_height
    radius = tl.load(radii + row, given, 0.0)
    # In float64, because squares of a large gradient are beyond float32.
    wide_x, wide_y = x.to(tl.float64), y.to(tl.float64)
    norm = tl.sqrt(wide_x * wide_x + wide_y * wide_y).to(tl.float32)
    # NaN compares as false.
    drawn = (radius > 0) & (norm < float("inf"))
    if STATISTICS:
        total = tl.load(gradient_sum + row, given, 0.0)
        tl.store(gradient_sum + row, total + tl.where(drawn, norm, 0.0), given)
        visited = drawn | VISITS_ALL
        tl.store(visits + row, tl.load(visits + row, given, 0) + visited.to(tl.int64), given)
        largest = tl.load(largest_screen + row, given, 0.0)
        # Rounded as torch and the library round.
        share = tl.div_rn(radius, longer + tl.zeros_like(radius))
        tl.store(largest_screen + row, tl.maximum(largest, share), given)
    if WATCHED:
        size = tl.abs(tl.load(watched_gradient + row, given, 0.0))
        total = tl.load(watched_sum + row, given, 0.0)
        tl.store(watched_sum + row, total + tl.where(drawn & (size < float("inf")), size, 0.0), given)
