"""Prepares a scene for the pixel kernels: records of the visible rows, and the tiles' lists."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton import records, rows
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.lists import PAIR_LIMIT, Lists, check_pairs, list_rows, list_tiles
from sparsestreet.ops.triton.sizes import COUNTED, Room
from sparsestreet.ops.triton.view import KernelView
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Gaussians


@dataclass(frozen=True)
class Projection:
    """A scene projected to the screen of one view, and the running sum over what each program counted (rows.py)."""

    table: Float[Tensor, " numbers"]
    records: Float[Tensor, "n 12"]
    tile_counts: Int[Tensor, " n"]
    radii: Float[Tensor, " n"]
    sums: Int[Tensor, " b"]


@dataclass(frozen=True)
class Screen:
    """A scene projected to the screen of one view."""

    table: Float[Tensor, " numbers"]
    records: Float[Tensor, "n 12"]
    tile_counts: Int[Tensor, " n"]
    radii: Float[Tensor, " n"]
    lists: Lists


def project(gaussians: Gaussians, view: KernelView) -> Screen:
    """Projects and lists all rows; waits for the device in between, for the numbers of rows and of pairs.

    Raises ValueError for bad values, PairLimitError.
    """
    projection = project_all(gaussians, view)
    return list_exactly(gaussians, projection, view)


def project_all(gaussians: Gaussians, view: KernelView) -> Projection:
    """Projects all rows."""
    fields, displacements = fields_of(gaussians), contiguous(gaussians.displacements)
    means, sh = fields[0], fields[4]
    n, settings, table = len(means), view.settings, view.table(means.device)
    splats, radii = means.new_empty(n, records.LENGTH), means.new_empty(n)
    tile_counts = means.new_empty(n, dtype=torch.int32)
    # A program counts an empty scene too.
    numbers = means.new_empty(3 * max(-(-n // rows.block_of(view)), 1), dtype=torch.int64)
    launch(
        rows.project_rows, max(n, 1), rows.block_of(view),
        *fields, given_or(displacements, means), table, splats, tile_counts, radii, numbers, n,
        TERMS=sh.shape[1], ANTIALIAS=settings.antialias, CLAMPED=settings.clamp_colors,
        HALF_COLORS=settings.half_colors, BOUNDED=view.bounded, **effects(view, displacements),
        options={"enable_fp_fusion": False},
    )  # fmt: skip
    # Of one line, because torch sums the columns of a table one row after the other.
    return Projection(table, splats, tile_counts, radii, numbers.cumsum(0))


def list_exactly(gaussians: Gaussians, projection: Projection, view: KernelView) -> Screen:
    """Lists what is visible, in no more room than that takes: waits for its size."""
    p = projection
    visible = list_rows(p.records, p.tile_counts, p.sums, Room(len(gaussians), PAIR_LIMIT), view)
    pairs, rows, bad = wait_for(visible.sizes.on_device[:COUNTED])
    if bad:
        check_values(gaussians)
    check_pairs(pairs, p.tile_counts)
    lists = list_tiles(p.records, visible, Room(rows, pairs), view)
    return Screen(p.table, p.records, p.tile_counts, p.radii, lists)


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
