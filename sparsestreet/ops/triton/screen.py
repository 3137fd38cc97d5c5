"""Prepares a scene for the pixel kernels: records of the visible rows, and the tiles' lists."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.host_copy import HostCopy, copy_to_host
from sparsestreet.ops.raster import SHAPE
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.lists import (
    PAIR_LIMIT,
    Lists,
    Visible,
    check_pairs,
    like,
    list_rows,
    list_tiles,
    predicted,
    remember,
)
from sparsestreet.ops.triton.parts import COUNTED, Room, Sizes
from sparsestreet.ops.triton.project import block_of, project_rows
from sparsestreet.ops.triton.view import GATE_PLACE, LENGTH, KernelView
from sparsestreet.ops.validate import check_values
from sparsestreet.types import Gaussians

Layers = TypeVar("Layers")


@dataclass(frozen=True)
class Projection:
    """A scene projected to the screen of one view."""

    table: Float[Tensor, " numbers"]
    records: Float[Tensor, "n 12"]
    tile_counts: Int[Tensor, " n"]
    radii: Float[Tensor, " n"]
    sums: Int[Tensor, " b"]
    """The running sum over what each program counted."""
    gated: bool
    """Whether records hold gates."""


@dataclass(frozen=True)
class Screen(Projection):
    """A projected scene with the tiles' lists."""

    lists: Lists


def project(gaussians: Gaussians, view: KernelView) -> Screen:
    """Project and list all rows; waits for the device in between, for the numbers of rows and of pairs.

    Raises ValueError for bad values, PairLimitError.
    """
    return list_exactly(gaussians, project_all(gaussians, view), view)


def draw(
    gaussians: Gaussians, view: KernelView, work: Callable[[Screen], Layers], gates: Float[Tensor, " n"] | None = None
) -> tuple[Screen, Layers]:
    """As ``project``, with what ``work`` makes of it, but the wait comes when all is queued, also the work.

    The room for the lists is a guess. If it is too small all that follows the projection is done again. Where views are
    known too little for a guess, it waits in between.
    """
    projection, rows = project_all(gaussians, view, gates), len(gaussians)
    place = like(rows, view, projection.records.device)
    room = predicted(place, rows, PAIR_LIMIT)
    if room is not None:
        visible = list_rows(projection.records, projection.tile_counts, projection.sums, room, view)
        counted = copy_to_host(visible.sizes.on_device)
        screen = list_in(room, projection, visible, view)
        layers = work(screen)
        read(visible.sizes, counted, gaussians, projection)
        if room.holds(visible.sizes.pairs, visible.sizes.rows):
            remember(place, visible.sizes.rows, visible.sizes.pairs)
            return screen, layers
        del screen, layers
    screen = list_exactly(gaussians, projection, view)
    remember(place, screen.lists.sizes.rows, screen.lists.sizes.pairs)
    return screen, work(screen)


def project_all(gaussians: Gaussians, view: KernelView, gates: Float[Tensor, " n"] | None = None) -> Projection:
    """Project all rows, as if their gates were 1, and put the gates into the records."""
    fields, displacements = fields_of(gaussians), contiguous(gaussians.displacements)
    means, block = fields[0], block_of(view)
    n, settings, table = len(gaussians), view.settings, view.table(means.device)
    splats, radii = means.new_empty(n, LENGTH), means.new_empty(n)
    tile_counts = means.new_empty(n, dtype=torch.int32)
    # A program counts an empty scene too.
    blocks = max(-(-n // block), 1)
    numbers = means.new_empty(3 * blocks, dtype=torch.int64)
    for part in parts_of(fields, gaussians.terms):
        launch(
            project_rows, max(part.end - part.start // block * block, 1), block,
            *fields[:SHAPE], part.first, part.rest, given_or(displacements, means), table, splats, tile_counts, radii,
            numbers, part.start, part.end, blocks,
            TERMS=part.terms, STORED=part.stored, ANTIALIAS=settings.antialias, CLAMPED=settings.clamp_colors,
            HALF_COLORS=settings.half_colors, BOUNDED=view.bounded, **effects(view, displacements),
            options={"enable_fp_fusion": False},
        )  # fmt: skip
    if gates is not None:
        splats[:, GATE_PLACE] = gates
    # Of one line, because torch sums the columns of a table one row after the other.
    return Projection(table, splats, tile_counts, radii, numbers.cumsum(0), gates is not None)


def list_exactly(gaussians: Gaussians, projection: Projection, view: KernelView) -> Screen:
    """Lists what is visible, in no more room than that takes: waits for its size."""
    room = Room(len(gaussians), PAIR_LIMIT)
    visible = list_rows(projection.records, projection.tile_counts, projection.sums, room, view)
    sizes = visible.sizes
    read(sizes, copy_to_host(sizes.on_device), gaussians, projection)
    return list_in(Room(sizes.rows, sizes.pairs), projection, visible, view)


def list_in(room: Room, projection: Projection, visible: Visible, view: KernelView) -> Screen:
    return Screen(**vars(projection), lists=list_tiles(projection.records, visible, room, view))


def wait_for(numbers: HostCopy) -> list[int]:
    """The numbers, once they are there. Only here does the op wait for the device."""
    return numbers.wait().tolist()


def read(sizes: Sizes, counted: HostCopy, gaussians: Gaussians, projection: Projection) -> None:
    """Wait for the sizes; raises what ``project`` raises."""
    pairs, rows, bad = wait_for(counted)[:COUNTED]
    if bad:
        check_values(gaussians)
    check_pairs(pairs, projection.tile_counts)
    sizes.pairs, sizes.rows = pairs, rows


def fields_of(gaussians: Gaussians) -> tuple[Tensor, ...]:
    """Means, quaternions, scales, opacities and the tables of harmonics as kernels read them."""
    return tuple(map(Tensor.contiguous, gaussians.learned()))


@dataclass(frozen=True)
class Part:
    """Rows whose harmonics are of the same tables; kernels of rows are launched once for each."""

    places: tuple[int, int]
    """Of ``first`` and ``rest`` among all tables."""
    start: int
    end: int
    first: Float[Tensor, "_ _ 3"]
    rest: Float[Tensor, "_ _ 3"]
    terms: int
    """Coefficients in use."""
    stored: int
    """Of ``rest``; -1: ``first`` and ``rest`` are the one table of all."""


def parts_of(fields: Sequence[Tensor], terms: int | None) -> list[Part]:
    """The parts that have rows; one of no row if all are empty."""
    if terms is None:
        sh = fields[SHAPE]
        return [Part((0, 0), 0, len(sh), sh, sh, sh.shape[1], -1)]
    count, start, parts = (len(fields) - SHAPE) // 2, 0, []
    for place in range(count):
        first, rest = fields[SHAPE + place], fields[SHAPE + count + place]
        stored, end = rest.shape[1], start + len(first)
        # A table without numbers has no address.
        rest = rest if stored else first
        parts.append(Part((place, count + place), start, end, first, rest, min(1 + stored, terms), stored))
        start = end
    return [part for part in parts if part.end > part.start] or parts[:1]


def contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.contiguous()


def given_or(tensor: Tensor | None, other: Tensor) -> Tensor:
    """``tensor``, or ``other`` in its place if it is missing; the kernel does not read it then."""
    return other if tensor is None else tensor


def effects(view: KernelView, displacements: Tensor | None) -> dict[str, Any]:
    """The switches of the row kernels."""
    moves = displacements is not None
    return {"DISTORTED": view.distorted, "ROLLING": view.rolling, "COLUMNS": view.columns, "DISPLACED": moves}
