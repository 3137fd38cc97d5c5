"""Prepares a scene for the pixel kernels: records of the visible rows, and the tiles' lists."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton import records, rows
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.lists import Lists, check_pairs, list_tiles
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Gaussians


@dataclass(frozen=True)
class Screen:
    """A scene projected to the screen of one view."""

    table: Float[Tensor, " numbers"]
    records: Float[Tensor, "n 12"]
    tile_counts: Int[Tensor, " n"]
    radii: Float[Tensor, " n"]
    lists: Lists


def project(gaussians: Gaussians, view: KernelView) -> Screen:
    """Projects all rows; waits for the device once, for the numbers of rows and of pairs.

    Raises ValueError for bad values, PairLimitError.
    """
    fields, displacements = fields_of(gaussians), contiguous(gaussians.displacements)
    means, sh = fields[0], fields[4]
    n, settings, table = len(means), view.settings, view.table(means.device)
    splats, radii = means.new_empty(n, records.LENGTH), means.new_empty(n)
    tile_counts = means.new_empty(n, dtype=torch.int32)
    numbers = means.new_empty(-(-n // rows.block_of(view)), 3, dtype=torch.int64)
    launch(
        rows.project_rows, n, rows.block_of(view),
        *fields, given_or(displacements, means), table, splats, tile_counts, radii, numbers, n,
        TERMS=sh.shape[1], ANTIALIAS=settings.antialias, CLAMPED=settings.clamp_colors,
        HALF_COLORS=settings.half_colors, BOUNDED=view.bounded, **effects(view, displacements),
        options={"enable_fp_fusion": False},
    )  # fmt: skip
    places = (tile_counts > 0).cumsum(0, dtype=torch.int32)
    pairs, visible, bad = wait_for(numbers.sum(0))
    if bad:
        check_values(gaussians)
    check_pairs(pairs, tile_counts)
    return Screen(table, splats, tile_counts, radii, list_tiles(splats, tile_counts, places, visible, pairs, view))


def wait_for(numbers: Int[Tensor, " numbers"]) -> list[int]:
    """Copies the numbers to the host. Only here does the op wait for the device."""
    return numbers.tolist()


def fields_of(gaussians: Gaussians) -> tuple[Tensor, ...]:
    """Means, quaternions, scales, opacities and harmonics as kernels read them."""
    g = gaussians
    return tuple(field.contiguous() for field in (g.means, g.quaternions, g.scales, g.opacities, g.sh))


def contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def given_or(tensor: Tensor | None, other: Tensor) -> Tensor:
    """``tensor``, or ``other`` in its place if it is missing; the kernel does not read it then."""
    return other if tensor is None else tensor


def effects(view: KernelView, displacements: Tensor | None) -> dict[str, Any]:
    """The switches of the row kernels."""
    moves = displacements is not None
    return {"DISTORTED": view.distorted, "ROLLING": view.rolling, "COLUMNS": view.columns, "DISPLACED": moves}
