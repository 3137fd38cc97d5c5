"""Add what one view shows of each row to the sums that density control looks at, in place and in one pass.

In plain torch it is a dozen small operations a node, which cost the host more than the device. A row's norm is that of
its gradient on screen scaled to half the image, |(g_x W/2, g_y H/2)|_2, as in 3DGS (Kerbl et al. 2023).
"""

from collections.abc import Sequence
from ctypes import byref

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT

Watched = tuple[Float[Tensor, " n"], Float[Tensor, " n"]]
"""Sum of a column's absolute gradient, and the gradient in this view."""


@torch.no_grad()
def add_view_(
    gradient_sum: Float[Tensor, " n"],
    visits: Int64[Tensor, " n"],
    largest_screen: Float[Tensor, " n"],
    screen_gradient: Float[Tensor, "n 2"],
    radii: Float[Tensor, " n"],
    size: tuple[int, int],
    *,
    visits_all: bool = False,
    watched: Sequence[Watched] = (),
    backend: str = "auto",
) -> None:
    """Add a view's norms and visits, and keep the largest radius; on a GPU one launch, or one a watched column.

    Rows with radius 0 were not drawn: they have no visit and no gradient, nor have rows whose gradient is not finite. A
    watched gradient that is not finite is left out by itself.

    Args:
        gradient_sum: sum of the norms.
        visits: number of views.
        largest_screen: largest radius as a fraction of the longer side.
        screen_gradient: absolute gradient of the loss per pixel of the projected mean.
        radii: pixels.
        size: width and height of the image, pixels.
        visits_all: whether every row counts as visited.
        watched: columns whose gradients are summed too.
        backend: "torch", "cpu", "triton", or "auto" for the one that suits the tensors.

    Raises:
        ValueError: as ``fused_backend`` does.
        RuntimeError: as ``fused_backend`` does.
    """
    sums = (gradient_sum, largest_screen, *(total for total, _ in watched))
    view = [screen_gradient.contiguous(), radii.contiguous()]
    watched = [(total, gradient.contiguous()) for total, gradient in watched]
    chosen = fused_backend(backend, *sums, *view, *(gradient for _, gradient in watched))
    if chosen == "torch":
        _in_torch_(gradient_sum, visits, largest_screen, view[0], view[1], size, visits_all, watched)
        return
    add_ = _add_in_library_
    if chosen == "triton":
        from sparsestreet.ops.triton.statistics import add_view_ as add_
    statistics = (gradient_sum, visits, largest_screen)
    for place, column in enumerate(watched or [None]):
        add_(statistics if place == 0 else None, view[0], view[1], size, visits_all, column)


def _add_in_library_(
    statistics: tuple[Tensor, Tensor, Tensor] | None,
    screen_gradient: Tensor,
    radii: Tensor,
    size: tuple[int, int],
    visits_all: bool,
    watched: Watched | None,
) -> None:
    view = native.CScreenView(
        len(radii), *native.pointers(screen_gradient, radii), *(side / 2 for side in size), max(size), visits_all,
        native.thread_count(),
    )  # fmt: skip
    written = native.pointers(*(statistics or (None,) * 3), *(watched or (None,) * 2))
    native.load_library().splat_statistics(radii.dtype == torch.float64, FASTEST_VARIANT, byref(view), byref(written))


def _in_torch_(
    gradient_sum: Tensor,
    visits: Tensor,
    largest_screen: Tensor,
    screen_gradient: Tensor,
    radii: Tensor,
    size: tuple[int, int],
    visits_all: bool,
    watched: Sequence[Watched],
) -> None:
    width, height = size
    norm = torch.hypot(screen_gradient[:, 0] * (width / 2), screen_gradient[:, 1] * (height / 2))
    drawn = (radii > 0) & (norm < torch.inf)
    gradient_sum += torch.where(drawn, norm, 0.0)
    visits += 1 if visits_all else drawn
    torch.maximum(largest_screen, (radii / max(size)).to(largest_screen.dtype), out=largest_screen)
    for total, gradient in watched:
        absolute = gradient.abs()
        total += torch.where(drawn & (absolute < torch.inf), absolute, 0.0)
